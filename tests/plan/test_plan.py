"""The plan: which stages run, which are skipped and which options are settled, by kind of scene."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.config.presets import PRESETS
from pipeline.config.schema import Config
from pipeline.geometry.cube import panorama_face_side
from pipeline.io.colmap import read_model, write_model
from pipeline.plan.plan import describe
from pipeline.plan.scan import scan
from pipeline.plan.settle import FEW_PHOTOS
from pipeline.plan.values import Plan
from pipeline.runtime.errors import UserError
from stages.workflow.registry import STAGES
from tests.io.test_llff import llff_row
from tests.io.test_transforms import frame, write
from tests.pictures import photos, picture
from tests.plan.scans import look, many, plan_of, posed
from tests.plan.test_scan import write_dng, write_sparse
from tests.plans import make_plan, skipped


def test_photographs_alone_need_everything_but_raw(tmp_path):
    photos(tmp_path / "images", 3)
    plan = plan_of(tmp_path)
    assert list(plan.stages) == list(STAGES)
    assert skipped(plan) == ["decode", "refine"]
    assert all(stage.reason for stage in plan.stages.values())


def test_raw_needs_decode(tmp_path):
    for i in range(2):
        write_dng(tmp_path / f"{i}.dng")
    assert skipped(plan_of(tmp_path)) == ["refine"]


@pytest.mark.parametrize("model, undistort", [("PINHOLE", []), ("SIMPLE_RADIAL", ["undistort"])])
def test_given_colmap_poses(tmp_path, model, undistort):
    files = photos(tmp_path / "images", 3)
    write_sparse(tmp_path / "sparse" / "0", [path.name for path in files], (64, 48), model)
    plan = plan_of(tmp_path, init={"method": "points"})
    runs = {"features", "matches", "sfm", "decode", "undistort"} - set(skipped(plan))
    assert sorted(runs) == undistort
    assert "3 cameras" in plan.stages["sfm"].reason and model in plan.stages["undistort"].reason
    assert "1 sparse points" in plan.stages["init"].reason
    ignoring = plan_of(tmp_path, poses="ignore")
    assert skipped(ignoring) == ["decode", "refine"] and "ignore" in ignoring.stages["sfm"].reason


def with_principal_point_off_centre(folder: Path) -> Path:
    """A calibrated principal point."""
    sparse = folder / "sparse" / "0"
    model = read_model(sparse)
    model.cameras[1].params[2] += 0.25
    write_model(sparse, model)
    return folder


def test_given_poses_with_tracks_and_principal_points_at_the_centre_are_refined(tmp_path):
    plan = plan_of(posed(tmp_path, tracks=20, size=(128, 96)))
    assert skipped(plan) == ["decode", "features", "matches", "sfm", "undistort"]
    assert "not calibrated" in plan.stages["refine"].reason


@pytest.mark.parametrize(
    "change, options, why",
    [
        ({"tracks": 20}, {"poses": "keep"}, "poses: keep"),
        ({"tracks": 20}, {"sfm": {"refine_principal_point": "no"}}, "fixed"),
        ({"tracks": 19}, {}, "19 tracked points"),
        ({"tracks": 0}, {}, "no tracks"),
        ({"tracks": 20, "count": 4}, {}, "no camera with 5"),
    ],
)
def test_given_poses_that_gain_nothing_are_not_refined(tmp_path, change, options, why):
    plan = plan_of(posed(tmp_path, **change), **options)
    assert not plan.runs("refine") and why in plan.stages["refine"].reason


def test_a_calibrated_lens_is_refined_on_demand_alone(tmp_path):
    scene = with_principal_point_off_centre(posed(tmp_path, tracks=20))
    assert "no camera with 5" in plan_of(scene).stages["refine"].reason
    assert plan_of(scene, sfm={"refine_principal_point": "yes"}).runs("refine")


def test_given_poses_without_points_are_triangulated(tmp_path):
    picture(tmp_path / "train" / "a.png", mode="RGBA")
    picture(tmp_path / "train" / "b.png", mode="RGBA")
    frames = [frame(path=f"./train/{name}") for name in "ab"]
    write(tmp_path, {"camera_angle_x": 0.7, "frames": frames}, "transforms_train.json")
    plan = plan_of(tmp_path)
    assert skipped(plan) == ["decode", "features", "matches", "refine", "sfm", "undistort"]
    assert "triangulated" in plan.stages["init"].reason
    assert plan.config.train.background == "white"
    assert "random" in plan_of(tmp_path, init={"method": "random"}).stages["init"].reason


def test_llff(tmp_path):
    photos(tmp_path / "images", 2)
    np.save(tmp_path / "poses_bounds.npy", [llff_row(np.eye(3), np.zeros(3), 48, 64, 50.0)] * 2)
    assert skipped(plan_of(tmp_path)) == [
        "decode",
        "features",
        "matches",
        "refine",
        "sfm",
        "undistort",
    ]


@pytest.mark.parametrize("model, runs", [("PINHOLE", False), ("auto", True), ("OPENCV", True)])
def test_undistort_follows_the_camera_model_of_sfm(tmp_path, model, runs):
    photos(tmp_path / "images", 2)
    plan = plan_of(tmp_path, sfm={"camera_model": model})
    assert plan.runs("undistort") == runs and "cameras" in plan.stages["undistort"].reason


def test_options_are_settled(tmp_path):
    photos(tmp_path / "images", 3)
    config = plan_of(tmp_path).config
    assert config.inspect.image_folder == "images"
    assert (config.matches.pairs, config.sfm.mapper) == ("exhaustive", "incremental")
    assert (config.sfm.camera_model, config.sfm.share_cameras) == ("SIMPLE_RADIAL", "group")
    assert (config.init.method, config.train.background) == ("dense", "measured")


def test_photographs_decide_on_the_background_unless_it_is_known_before(tmp_path):
    """A mask may hide a passer-by, so masks are measured as well."""
    photos(tmp_path / "images", 2)
    original = plan_of(tmp_path, train={"density": {"strategy": "original"}})
    assert original.config.train.background == "black"
    picture(tmp_path / "images" / "p.png", mode="RGBA")
    assert plan_of(tmp_path).config.train.background == "black"
    (tmp_path / "images" / "p.png").unlink()
    (tmp_path / "masks").mkdir()
    first = min((tmp_path / "images").iterdir()).stem
    picture(tmp_path / "masks" / f"{first}.png", mode="L")
    plan = plan_of(tmp_path)
    assert plan.config.train.background == "measured"
    assert any("a skybox if they show sky" in text for text in plan.stages["train"].decisions)


@pytest.mark.parametrize(
    ("sections", "reason", "expected"),
    [
        ({"init": {"method": "dense"}}, "init.method: dense", {"init", "train"}),
        # An export reruns no training.
        ({"export": {"formats": ["ply", "dense_maps"]}}, "export.formats: dense_maps", {"export"}),
    ],
)
def test_depth_maps_are_estimated_for_what_needs_them(tmp_path, sections, reason, expected):
    photos(tmp_path / "images", 3)
    sections = {"init": {"method": "points"}} | sections
    plan = plan_of(tmp_path, init={"method": "points"})
    assert not plan.runs("dense") and "init.method: points" in plan.stages["dense"].reason
    assert "dense" not in plan.stages["init"].inputs
    plan = plan_of(tmp_path, **sections)
    assert plan.runs("dense") and reason in plan.stages["dense"].reason
    readers = {name for name, stage in plan.stages.items() if "dense" in stage.inputs}
    assert readers == expected


def test_few_photographs_are_initialised_from_depth_maps(tmp_path):
    photos(tmp_path / "images", 3)
    assert plan_of(tmp_path).config.init.method == "dense"
    assert all(PRESETS[preset]["init"]["method"] == "points" for preset in ("fast", "original"))
    for count, method in ((FEW_PHOTOS, "dense"), (FEW_PHOTOS + 1, "points")):
        found = many(tmp_path / str(count), count)
        assert make_plan(found, Config()).config.init.method == method


def test_dense_initialisation_does_not_use_the_scenes_cloud(tmp_path):
    names = [path.name for path in photos(tmp_path / "images", 3)]
    write_sparse(tmp_path / "sparse" / "0", names, (64, 48))
    (tmp_path / "points.xyz").write_text("0 0 0\n1 1 1\n")
    assert plan_of(tmp_path).config.init.method == "points"
    init = plan_of(tmp_path, init={"method": "dense"}).stages["init"]
    assert "fused depth maps" in init.reason and "init.method: points" in init.decisions[0]


def images(folder: Path) -> None:
    photos(folder / "images", 2)


def smaller_copy(folder: Path) -> None:
    photos(folder / "images", 2, (1280, 960))
    photos(folder / "images_2", 2, (960, 720))
    write_sparse(folder / "sparse" / "0", ["p00.jpg", "p01.jpg"], (1280, 960))


def plain(folder: Path) -> None:
    photos(folder, 2)
    photos(folder / "masks", 2, mode="L")
    photos(folder / "thumbs", 2)


def subfolders(folder: Path) -> None:
    photos(folder / "left", 1)
    photos(folder / "right", 1)
    photos(folder / "masks" / "left", 1, mode="L")


def lone_subfolder(folder: Path) -> None:
    photos(folder / "input", 2)
    photos(folder / "input" / "masks", 2, mode="L")


def nerf_synthetic(folder: Path) -> None:
    for split in ("train", "test"):
        picture(folder / split / "r_0.png")
        picture(folder / split / "r_0_depth.png")
        content = {"camera_angle_x": 0.7, "frames": [frame(path=f"./{split}/r_0")]}
        write(folder, content, f"transforms_{split}.json")


def nerfstudio(folder: Path) -> None:
    photos(folder / "scan_2024", 3)
    frames = [frame(path=f"scan_2024/p0{i}.jpg") for i in range(2)]
    write(folder, {"fl_x": 50, "frames": frames})


@pytest.mark.parametrize(
    "layout",
    [images, smaller_copy, plain, subfolders, lone_subfolder, nerf_synthetic, nerfstudio],
)
@pytest.mark.parametrize("poses", ["auto", "ignore"])
def test_a_settled_config_finds_the_same_scene(tmp_path, layout, poses):
    """Stages scan the folder with the settled config and must find what the plan found."""
    layout(tmp_path)
    first = look(tmp_path, poses=poses)
    settled = make_plan(first, Config(poses=poses)).config
    again = scan(tmp_path, tmp_path.name, settled, cache=None)
    assert again.model_copy(update={"image_folder_reason": first.image_folder_reason}) == first
    assert make_plan(again, settled).config == settled


def test_configured_options_do_not_change(tmp_path):
    chosen = {
        "matches": {"pairs": "sequential"},
        "sfm": {"mapper": "global", "camera_model": "OPENCV", "share_cameras": "single"},
        "train": {"background": "white"},
        "init": {"method": "random"},
    }
    photos(tmp_path / "images", 2)
    config = plan_of(tmp_path, **chosen).config.model_dump()
    for section, values in chosen.items():
        assert {key: config[section][key] for key in values} == values


@pytest.mark.parametrize(
    "count, changes, pairs, mapper",
    [
        (40, {}, "exhaustive", "incremental"),
        (41, {}, "retrieval", "incremental"),
        (151, {}, "retrieval", "incremental"),
        (90, {"gps": lambda i: (50.0, 8.0 + 1e-4 * i, 0.0)}, "spatial", "incremental"),
        # Positions within the error of GPS.
        (90, {"gps": lambda i: (50.0, 8.0 + 1e-6 * i, 0.0)}, "retrieval", "incremental"),
        (90, {"gps": lambda i: (50.0, 8.0 + 1e-4 * i, 0.0) if i % 2 else None}, "retrieval", None),
    ],
)
def test_pairs_and_mapper(tmp_path, count, changes, pairs, mapper):
    plan = make_plan(many(tmp_path, count, **changes), Config())
    assert plan.config.matches.pairs == pairs
    assert any(pairs in line for line in plan.stages["matches"].decisions)
    assert mapper is None or plan.config.sfm.mapper == mapper


def test_ordered_photographs_are_matched_in_sequence(tmp_path):
    seen = many(tmp_path, 90).model_copy(update={"ordered": "numbered like a video"})
    assert make_plan(seen, Config()).config.matches.pairs == "sequential"


@pytest.mark.parametrize(
    "group, share, model",
    [
        (lambda i: "NIKON D60 | ? | 29 mm | 64x48", "group", "SIMPLE_RADIAL"),
        (lambda i: f"Body {i % 4} | ? | 29 mm | 64x48", "image", "SIMPLE_RADIAL"),
        (lambda i: f"{64 + i}x48", "image", "SIMPLE_RADIAL"),
        (lambda i: f"{64 + i % 2}x48", "group", "SIMPLE_RADIAL"),
        (lambda i: "X | 8mm Fisheye | 8 mm | 64x48", "group", "OPENCV_FISHEYE"),
    ],
)
def test_cameras(tmp_path, group, share, model):
    sfm = make_plan(many(tmp_path, 12, camera_group=group), Config()).config.sfm
    assert (sfm.share_cameras, sfm.camera_model) == (share, model)


def test_panoramas_have_spherical_cameras_and_six_views_each(tmp_path):
    seen = many(tmp_path, 4, panorama=lambda i: True)
    plan = make_plan(seen, Config())
    assert plan.config.sfm.camera_model == "EQUIRECTANGULAR"
    assert plan.stages["undistort"].run and "panoramas" in plan.stages["undistort"].reason
    assert any("24 views" in line for line in plan.stages["train"].decisions)
    one = seen.photos[0].model_copy(update={"panorama": False})
    mixed = seen.manifest.model_copy(update={"photos": (one, *seen.photos[1:])})
    plan = make_plan(seen.model_copy(update={"manifest": mixed}), Config())
    assert plan.config.sfm.camera_model == "SIMPLE_RADIAL"
    assert any("3 panoramas" in line for line in plan.stages["sfm"].decisions)


@pytest.mark.parametrize(("panoramas", "part"), [(40, "a panorama"), (1, "a view")])
def test_the_views_of_a_panorama_show_different_parts_of_the_scene(tmp_path, panoramas, part):
    """Its budget is that of its views together, unless most views are of other photographs."""
    size = {"width": lambda i: 1200 if i < panoramas else 640}
    size["height"] = lambda i: 600 if i < panoramas else 480
    plan = make_plan(many(tmp_path, 80, panorama=lambda i: i < panoramas, **size), Config())
    side = panorama_face_side(1200)
    pixels = 6 * side**2 if part == "a panorama" else 640 * 480
    budget = plan.config.train.density.max_gaussians
    assert budget == round(pixels / 2)
    assert (
        f"at most {budget} Gaussians: one per 2 pixels of {part}" in plan.stages["train"].decisions
    )


def test_photographs_of_2_to_1_are_panoramas_only_if_the_options_say_so(tmp_path):
    photos(tmp_path / "images", 2, (1200, 600))
    plan = plan_of(tmp_path)
    assert any("sfm.camera_model: EQUIRECTANGULAR" in line for line in plan.warnings)
    assert plan.config.sfm.camera_model == "SIMPLE_RADIAL"
    plan = plan_of(tmp_path, sfm={"camera_model": "EQUIRECTANGULAR"})
    assert not plan.warnings and plan.stages["undistort"].run
    picture(tmp_path / "images" / "narrow.jpg", (64, 48))
    with pytest.raises(UserError, match="64x48") as error:
        plan_of(tmp_path, sfm={"camera_model": "EQUIRECTANGULAR"})
    assert str(error.value.file).endswith("narrow.jpg")


def test_decisions_contain_the_resolution_and_the_split(tmp_path):
    photos(tmp_path / "images", 2, (72, 128))
    plan = plan_of(tmp_path, views={"max_long_side_px": 96}, split={"test_every": 5})
    assert plan.facts.view_size == (54, 96)
    assert any("54x96" in line and "0.75" in line for line in plan.stages["train"].decisions)
    assert "one view in 5" in plan.stages["evaluate"].reason
    assert "no test views" in plan_of(tmp_path, split={"test_every": 0}).stages["evaluate"].reason


def test_facts_and_warnings_go_with_the_plan(tmp_path):
    files = photos(tmp_path / "images", 2)
    (tmp_path / "images" / "x.jpg").write_text("no picture")
    write_sparse(tmp_path / "sparse_gt", [path.name for path in files], (64, 48))
    plan = plan_of(tmp_path)
    assert plan.facts.photographs == 2 and plan.facts.truth == "sparse_gt"
    assert any("x.jpg" in line for line in plan.warnings)
    assert any("sparse_gt" in line for line in plan.stages["evaluate"].decisions)
    assert Plan.model_validate_json(plan.model_dump_json()) == plan


def test_description_names_every_stage_once(tmp_path):
    photos(tmp_path / "images", 2)
    plan = plan_of(tmp_path)
    *running, skipped_line = describe(plan).splitlines()
    shared = "coarse, partition, block, polish (the scene is trained as one block)"
    assert skipped_line.startswith("  skipped: decode (") and shared in skipped_line
    for name, stage in plan.stages.items():
        lines = [line for line in running if line.split()[:1] == [name]]
        assert len(lines) == stage.run and all(stage.reason in line for line in lines)
        assert stage.run or (name in skipped_line and stage.reason in skipped_line)


def test_planning_imports_nothing_heavy():
    """The Snakefile makes the plan at every start, before any job."""
    program = (
        "import sys, pipeline.plan.plan, pipeline.plan.given_poses, pipeline.scene.views;"
        "print([m for m in ('torch', 'cv2', 'scipy', 'skimage', 'pycolmap', 'rawpy', 'tifffile')"
        " if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr
