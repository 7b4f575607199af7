"""Every option changes the outputs of a stage that declares it; other options change none."""

from __future__ import annotations

import hashlib
import itertools
import json
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config.options import option_paths
from pipeline.config.schema import Config
from stages.workflow.registry import STAGES
from tests.once import made_once
from tests.stages.micro import Runner, with_option, write_scenes

Outputs = Callable[..., dict[str, str]]


@dataclass(frozen=True)
class Flip:
    """Another value for an option, and the options under which it has an effect."""

    value: Any
    options: dict[str, Any] = field(default_factory=dict)
    scene: str = "photos"


def under(**options: Any) -> dict[str, Any]:
    """Options by dotted paths, with ``__`` for the dot, added to those of every run."""
    given = {
        "views": {"max_long_side_px": 64},
        "train": {
            "steps": 40,
            "appearance": "none",  # measuring exposures takes as long as these steps
            "background": "black",  # a fill would take most of these Gaussians
            "density": {"strategy": "gradient", "max_gaussians": 600},
        },
    }
    for path, value in options.items():
        given = with_option(given, path.replace("__", "."), value)
    return given


POSED = under(poses="keep")
ESTIMATED = under(poses="ignore")
FIXED = under(poses="auto", sfm__refine_principal_point="no")
RANDOM = under(poses="keep", init__method="random", experiments__init__num_random=500)
MCMC = under(poses="keep", train__density__strategy="mcmc")
RESETS = under(poses="keep", experiments__train__gradient__opacity_reset_interval=1000)
DARK = under(poses="keep", experiments__train__sh0_learning_rate=1.0)
LARGE = under(poses="keep", views__max_long_side_px=200)
FULL = under(poses="keep", experiments__init__opacity=0.05, train__density__max_gaussians=320)
BLOCKS = under(poses="keep", partition__blocks=2, export__formats=["ply", "blocks"])
FILL = under(poses="keep", train__background="fill", train__density__max_gaussians=1500)
DENSE = under(poses="keep", init__method="dense", export__formats=["dense_points", "dense_maps"])
MESH = under(poses="keep", export__formats=["mesh"])
VIDEO = under(
    poses="keep", export__formats=["video"], export__video__seconds=1.0, export__video__fps=4
)

_T, _G, _M = "experiments.train", "experiments.train.gradient", "experiments.train.mcmc"

FLIPS = {
    "poses": Flip("ignore", POSED),
    "seed": Flip(1, POSED),
    "inspect.image_folder": Flip("others", POSED),
    "inspect.min_images": Flip(100, POSED),
    "experiments.inspect.keep_duplicates": Flip(True, ESTIMATED, "copies"),
    "views.max_long_side_px": Flip(48, POSED),
    "views.masks": Flip("ignore", POSED),
    "split.source": Flip("every", POSED, "split"),
    "split.test_every": Flip(5, POSED),
    "split.train_views": Flip(4, POSED),
    **{
        f"decode.{name}": Flip(value, POSED, "raw")
        for name, value in (
            ("demosaic", "linear"),
            ("half_size", True),
            ("linear", True),
            ("white_balance", "daylight"),
        )
    },
    "video.max_frames": Flip(3, POSED, "video"),
    "features.backend": Flip("colmap", ESTIMATED),
    "features.max_features": Flip(50, ESTIMATED),
    "features.max_long_side_px": Flip(150, ESTIMATED),
    "matches.pairs": Flip("sequential", ESTIMATED | {"matches": {"neighbours": 2}}),
    "matches.neighbours": Flip(2, ESTIMATED | {"matches": {"pairs": "sequential"}}),
    "experiments.matches.min_inliers": Flip(60, ESTIMATED),
    "experiments.matches.max_ratio": Flip(0.6, ESTIMATED),
    "sfm.mapper": Flip("global", ESTIMATED),
    "sfm.camera_model": Flip("SIMPLE_PINHOLE", ESTIMATED),
    "sfm.share_cameras": Flip("image", ESTIMATED),
    "sfm.refine_principal_point": Flip("yes", FIXED),
    "undistort.blank_pixels": Flip(1.0, POSED),
    "undistort.jpeg_quality": Flip(50, POSED),
    "undistort.mask_nadir_degrees": Flip(30.0, POSED, "panoramas"),
    "init.method": Flip("random", POSED),
    "init.max_points": Flip(100, POSED),
    "init.points_file": Flip("scan.csv", POSED),
    "experiments.init.opacity": Flip(0.2, POSED),
    "experiments.init.num_random": Flip(400, RANDOM),
    "train.steps": Flip(41, POSED),
    "train.budget_minutes": Flip(0.01, POSED),
    "train.sh_degree": Flip(1, POSED),
    "train.background": Flip("random", POSED),
    "train.appearance": Flip("exposure", POSED),
    f"{_T}.appearance_size": Flip(2, under(poses="keep", train__appearance="embedding")),
    "train.refine_poses": Flip(True, POSED),
    "train.refine_intrinsics": Flip(True, POSED),
    "train.antialias": Flip(True, POSED),
    "train.ssim_loss_weight": Flip(0.2, POSED),
    "train.depth_loss_weight": Flip(0.0, POSED),
    "experiments.train.mask_loss_weight": Flip(0.0, POSED),
    "train.density.strategy": Flip("mcmc", POSED),
    "train.density.max_gaussians": Flip(400, POSED),
    f"{_T}.coarse_share": Flip(0.0, LARGE),
    f"{_T}.sh_degree_interval": Flip(2000, POSED),
    f"{_T}.squared_error_loss_weight": Flip(0.0, POSED),
    f"{_T}.alpha_loss_weight": Flip(0.0, POSED, "alpha"),
    f"{_T}.clamp_color_gradient": Flip(True, DARK),
    f"{_T}.dropout": Flip(0.5, POSED),
    f"{_T}.views_per_sh_coefficient": Flip(100.0, POSED),
    f"{_T}.max_pose_change": Flip(1e-6, under(poses="keep", train__refine_poses=True)),
    f"{_T}.max_intrinsics_change": Flip(1e-6, under(poses="keep", train__refine_intrinsics=True)),
    f"{_T}.adam_beta1": Flip(0.9, POSED),
    f"{_T}.adam_epsilon": Flip(0.0, POSED),
    f"{_T}.means_learning_rate_unit": Flip("camera_extent", POSED),
    f"{_T}.learning_rate_factor": Flip(1.0, POSED),
    f"{_G}.start_step": Flip(3000, POSED),
    f"{_G}.stop_share": Flip(0.3, POSED),
    f"{_G}.interval": Flip(2000, POSED),
    f"{_G}.prune_opacity": Flip(0.25, POSED),
    f"{_G}.grad_threshold": Flip(1.0, POSED),
    f"{_G}.recycle_share": Flip(0.0, FULL),
    f"{_G}.prune_scale": Flip(1e-3, RESETS),
    f"{_G}.opacity_reset_interval": Flip(1000, POSED),
    f"{_M}.start_step": Flip(3000, MCMC),
    f"{_M}.stop_share": Flip(0.3, MCMC),
    f"{_M}.interval": Flip(2000, MCMC),
    f"{_M}.prune_opacity": Flip(0.25, MCMC),
    f"{_M}.growth_share": Flip(0.2, MCMC),
    f"{_M}.noise": Flip(False, MCMC),
    "partition.blocks": Flip(3, BLOCKS),
    "holes.fill": Flip("inpaint", FILL),
    "evaluate.lpips_net": Flip("none", POSED),
    "export.formats": Flip(["ply"], POSED),
    "export.sh_degree": Flip(1, POSED),
    "experiments.export.min_opacity": Flip(0.25, POSED),
    "export.max_gaussians": Flip(100, POSED),
    "export.region": Flip("subject", POSED),
    "export.mesh_voxel": Flip(0.5, MESH),
    "export.mesh_faces": Flip(40, MESH),
    "export.texture_px": Flip(64, MESH),
    "export.video.path": Flip("cameras", VIDEO),
    "export.video.seconds": Flip(2.0, VIDEO),
    "export.video.fps": Flip(5, VIDEO),
    "export.video.long_side_px": Flip(48, VIDEO),
    "experiments.export.morton_order": Flip(False, POSED),
    "experiments.report.views": Flip(1, POSED),
}

DRAWN = {
    **{
        f"{_T}.{name}": POSED
        for name in (
            "means_learning_rate",
            "means_final_learning_rate",
            "scales_learning_rate",
            "quats_learning_rate",
            "opacities_learning_rate",
            "sh0_learning_rate",
            "shN_learning_rate",
            "learning_rate_decay_start",
            "learning_rate_final_factor",
        )
    },
    f"{_M}.opacity_loss_weight": MCMC,
    f"{_M}.scale_loss_weight": MCMC,
}
"""Options any other value of which changes the result, by the options of their runs."""

CONDITIONAL = {
    "preset": "sets other options",
    "sfm.min_registered_share": "a model that lacks photographs, which is an error",
    "sfm.component": "photographs that fall into several components",
    "sfm.georeference": "photographs with GPS, or gcp_list.txt",
    "export.ground_sampling_m": "photographs with GPS (tests/survey/test_maps.py)",
    "train.device": "a GPU (tests/training/test_device.py)",
    "train.transients": "30 epochs, and someone who passes by (tests/training/transients)",
    "train.density.pixels_per_gaussian": "views of more than 40 000 pixels",
    "train.density.remove_floaters": "floaters near cameras",
}
"""Options without an effect on these scenes, and what they need to have one."""


@pytest.fixture(scope="session")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "micro-scenes", write_scenes)


@pytest.fixture(scope="module")
def outputs(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Outputs]:
    """``Runner.outputs``; pycolmap's stages in a process without torch."""
    folder = tmp_path_factory.mktemp("micro")
    here = Runner(scenes, folder / "here")
    with pytest.MonkeyPatch.context() as patch:
        for name in ("TMPDIR", "TORCH_HOME"):
            patch.setenv(name, str(folder))  # stages change the first; no weights in the second
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, context, _start, (scenes, folder / "apart")) as apart:

            def run(run: str, scene: str, options: Any, stage: str, **machine: int) -> Any:
                if options["poses"] != "keep":
                    return apart.submit(_outputs, run, scene, options, stage).result()
                return here.outputs(run, scene, options, stage, **machine)

            yield run


def _start(scenes: Path, folder: Path) -> None:
    global _apart
    _apart = Runner(scenes, folder)


def _outputs(run: str, scene: str, options: Any, stage: str) -> dict[str, str]:
    return _apart.outputs(run, scene, options, stage)


_runs = itertools.count()


def declaring(path: str) -> list[str]:
    """The stages that declare an option, in the order of the DAG."""
    if path == "seed":
        return [name for name, spec in STAGES.items() if spec.seeded]
    return [
        name
        for name, spec in STAGES.items()
        if any(path == known or path.startswith(f"{known}.") for known in spec.options)
    ]


def value_of(options: dict[str, Any], path: str) -> Any:
    found: Any = Config.model_validate(options)
    for name in path.split("."):
        found = getattr(found, name)
    return found


def changes(outputs: Outputs, flip: Flip, path: str) -> bool:
    """Whether another value changes the outputs of a stage that declares the option."""
    base = hashlib.sha256(f"{flip.scene} {json.dumps(flip.options)}".encode()).hexdigest()[:12]
    run = f"flip-{next(_runs)}"
    other = with_option(flip.options, path, flip.value)
    return any(
        outputs(base, flip.scene, flip.options, stage) != outputs(run, flip.scene, other, stage)
        for stage in declaring(path)
    )


def test_every_option_has_a_place_here():
    placed = [*FLIPS, *DRAWN, *CONDITIONAL]
    assert sorted(placed) == sorted(option_paths())


@pytest.mark.parametrize("path", FLIPS)
def test_another_value_changes_an_output_of_a_declaring_stage(outputs, path):
    flip = FLIPS[path]
    assert value_of(flip.options, path) != flip.value
    assert changes(outputs, flip, path), f"{path}: {flip.value!r} changes no output"


@settings(max_examples=11, derandomize=True, deadline=None, database=None)
@given(st.data())
def test_any_other_value_of_a_rate_or_weight_changes_the_result(outputs, data):
    path = data.draw(st.sampled_from(sorted(DRAWN)))
    old = value_of(DRAWN[path], path)
    value = data.draw(st.floats(old / 4, min(4 * old, 0.99)).filter(lambda x: x != old))
    assert changes(outputs, Flip(value, DRAWN[path]), path), f"{path}: {value!r}"


def test_options_that_no_stage_declares_change_no_output(outputs):
    """Nor does the number of threads."""
    assert {path for path in option_paths() if not declaring(path)} == {"preset"}
    assert "partition.memory_mb" not in set(option_paths())
    other = with_option(with_option(POSED, "preset", "high"), "partition.memory_mb", 100_000)
    for stage in ("train", "evaluate", "coverage", "export"):
        expected = outputs("base", "photos", POSED, stage)
        assert expected
        found = outputs("machine", "photos", other, stage, threads=2, memory_mb=1)
        assert found == expected


def test_depth_maps_have_the_same_bits_at_any_number_of_threads(outputs):
    """And neither a run's seed nor the options of later stages change them."""
    expected = outputs("dense", "photos", DENSE, "dense")
    names = [name for name in expected if name.startswith("maps/")]
    assert "points.npz" in expected and names
    assert outputs("dense", "photos", DENSE, "dense", threads=2) == expected
    other = with_option(with_option(DENSE, "seed", 1), "train.steps", 41)
    assert outputs("dense-other", "photos", other, "dense") == expected
    exported = outputs("dense", "photos", DENSE, "export")
    assert "dense_points.ply" in exported
    assert sum(name.startswith("dense_maps/") for name in exported) == len(names)


def test_filled_holes_have_the_same_bits_at_any_number_of_threads_and_change_no_measure(outputs):
    filled = with_option(FILL, "holes.fill", "inpaint")
    for stage in ("holes", "export", "report"):
        expected = outputs("holes", "photos", filled, stage)
        assert expected, stage
        assert outputs("holes", "photos", filled, stage, threads=2) == expected, stage
    for stage in ("evaluate", "coverage"):
        assert outputs("holes", "photos", filled, stage) == outputs("fill", "photos", FILL, stage)
    exported = [
        outputs(run, "photos", o, "export") for run, o in (("holes", filled), ("fill", FILL))
    ]
    differing = {name for name in exported[0] if exported[0][name] != exported[1][name]}
    assert differing == {"point_cloud.ply", "point_cloud.spz", "frame.json"}


@pytest.mark.parametrize(
    ("path", "value"), [("views.max_long_side_px", 48), ("split.test_every", 5)]
)
def test_options_of_depth_maps_change_them(outputs, path, value):
    expected = outputs("dense", "photos", DENSE, "dense")
    assert outputs("dense-other", "photos", with_option(DENSE, path, value), "dense") != expected


def test_a_scene_in_blocks_has_the_same_bits_at_any_number_of_threads(outputs):
    """And each block is a job with an output of its own."""
    for stage in ("coarse", "partition", "block", "polish", "train", "export", "report"):
        expected = outputs("blocks", "photos", BLOCKS, stage)
        assert expected, stage
        found = outputs("blocks", "photos", BLOCKS, stage, threads=2, memory_mb=1)
        assert found == expected, stage
    assert {"polish_1/gaussians.npz", "polish_2/gaussians.npz"} <= outputs(
        "blocks", "photos", BLOCKS, "polish"
    ).keys()
    assert {"point_cloud.ply", "blocks/block_1.ply", "blocks/block_2.ply"} <= outputs(
        "blocks", "photos", BLOCKS, "export"
    ).keys()
