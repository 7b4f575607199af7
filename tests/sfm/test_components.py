"""Models of one scene: joined where several pairs of photographs agree, otherwise kept apart."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from benchmarks.judge import cases, world
from pipeline.config.settled import Sfm
from pipeline.io.colmap import read_model
from pipeline.metrics.pose import pose_error
from pipeline.runtime.errors import UserError
from pipeline.runtime.isolate import run_isolated
from tests.sfm import jobs

LOOK_ALIKE = "tower_2_sides"


def keep_pairs(source: Path, target: Path, kept: dict[tuple[int, int], int]) -> Path:
    """Copy a database with these pairs (image ids -> largest number of verified matches) only."""
    import pycolmap

    shutil.copyfile(source, target)
    with pycolmap.Database.open(target) as database:
        ids, geometries = database.read_two_view_geometries()
        for pair_id, geometry in zip(ids, geometries, strict=True):
            pair = pycolmap.pair_id_to_image_pair(pair_id)
            if pair not in kept:
                database.delete_two_view_geometry(*pair)
                database.delete_matches(*pair)
            elif len(geometry.inlier_matches) > kept[pair]:
                geometry.inlier_matches = geometry.inlier_matches[: kept[pair]]
                database.update_two_view_geometry(*pair, geometry)
    return target


def map_halves(folder: Path, case: str, shared: int, across: int, matches: int) -> dict[str, Any]:
    """Map two parts of a synthetic capture apart, and find the components of both together.

    Args:
        shared: The number of photographs in both parts.
        across: The number of pairs with a photograph in each part, and ``matches`` that of each.
    """
    import pycolmap

    from pipeline.sfm.attempts import Attempt
    from pipeline.sfm.components import Capture, find_components
    from pipeline.sfm.gaps import find_gaps
    from pipeline.sfm.judge import judge
    from pipeline.sfm.mappers import run_mapper
    from pipeline.sfm.models import quiet_colmap, write_model

    quiet_colmap()
    made = cases.make(case, 0)
    count = len(made.shots)
    written = world.write(made, folder / "all.db", 0)
    half = count // 2
    parts = [set(range(1, half + 1)), set(range(half + 1 - shared, count + 1))]
    if case == LOOK_ALIKE:  # Opposite sides: a third of the photographs each.
        parts = [set(range(1, count // 3 + 1)), set(range(half + 1, half + count // 3 + 1))]
    with pycolmap.Database.open(folder / "all.db") as database:
        ids, _ = database.read_two_view_geometry_num_inliers()
    pairs = sorted(map(pycolmap.pair_id_to_image_pair, ids))
    inside = [{pair: 10**6 for pair in pairs if set(pair) <= part} for part in parts]
    both = parts[0] | parts[1]
    between = [p for p in pairs if set(p) <= both and not any(p in each for each in inside)]
    joint = dict.fromkeys(sorted(between, key=lambda pair: pair[1] - pair[0])[:across], matches)
    models = [
        run_mapper(
            "incremental", keep_pairs(folder / "all.db", folder / f"{i}.db", kept), count, 0
        )[0]
        for i, kept in enumerate(inside)
    ]
    database_path = keep_pairs(
        folder / "all.db", folder / "joint.db", inside[0] | inside[1] | joint
    )
    capture = Capture(database_path, len(both), 0.5, 0)
    first = capture.judged(models[0])
    attempt = Attempt(
        "incremental", "", models, first.evidence, judge(first.evidence, 0.5), database_path
    )
    components, decisions = find_components(attempt, capture, lambda component: (component, []))
    write_model(components[0].model, folder / "joined")
    error = pose_error(read_model(folder / "joined"), written.truths[0])
    return {
        "sizes": [len(component.photographs) for component in components],
        "error": error.centre_relative_median,
        "decisions": decisions,
        "gaps": [gap.model_dump() for gap in find_gaps(database_path, components, 0)],
        "names": [c.summary("").photographs for c in components],
    }


@pytest.mark.parametrize(
    ("case", "shared", "across", "matches", "sizes"),
    [
        pytest.param("orbit", 4, 0, 0, [18], id="photographs in both"),
        pytest.param("orbit", 0, 6, 24, [18], id="weak pairs"),
        pytest.param("orbit", 0, 1, 24, [9, 9], id="one pair proves nothing"),
        pytest.param("orbit", 0, 0, 0, [9, 9], id="nothing in common"),
        pytest.param(LOOK_ALIKE, 0, 1000, 10**6, [8, 8], id="sides that look alike"),
    ],
)
def test_parts_are_joined_where_several_pairs_agree_and_nothing_is_folded(
    tmp_path, case, shared, across, matches, sizes
):
    found = run_isolated(map_halves, tmp_path, case, shared, across, matches)
    assert found["sizes"] == sizes, found
    assert found["error"] < 0.01
    gaps = [gap for gap in found["gaps"] if gap["component"] is not None]
    assert [gap["component"] for gap in gaps] == list(range(1, len(sizes)))
    for gap in gaps:
        assert gap["placed"] in found["names"][0] and gap["other"] in found["names"][1]


def test_every_component_is_kept_and_any_can_be_used(tmp_path):
    written = world.write(cases.make("two_rooms", 0), tmp_path / "database.db", 0)
    database = tmp_path / "database.db"
    for used, size in enumerate((16, 14)):
        out = tmp_path / str(used)
        report = run_isolated(
            jobs.reconstruct, written.manifest, database, Sfm(component=used), out
        )
        assert report["registered"] == size and report["verdict"] == "weak"
        listed = [(len(c["photographs"]), c["verdict"]) for c in report["components"]]
        assert listed == [(16, "good"), (14, "good")]
        assert any("sfm.component" in warning for warning in report["warnings"])
        for index, component in enumerate(report["components"]):
            assert component["folder"] == ("sparse/0" if index == used else f"other_models/{index}")
            names = read_model(out / component["folder"]).by_name()
            assert sorted(names) == component["photographs"]
    with pytest.raises(UserError, match=r"sfm\.component is 2, but the photographs gave 2 comp"):
        run_isolated(jobs.reconstruct, written.manifest, database, Sfm(component=2), tmp_path)


def lost_after(folder: Path, kept: int) -> list[int]:
    """The sizes of the models that are restored, of saved states of 5 and 8 photographs, if mapping
    kept a model of the first ``kept`` of them."""
    import pycolmap

    from pipeline.sfm.mappers import lost_model

    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=8, num_points3D=50
    )
    model = pycolmap.synthesize_dataset(options)
    states = folder / "states"

    def first(count: int) -> Any:
        part = pycolmap.Reconstruction(model)
        for frame_id in sorted(model.reg_frame_ids())[count:]:
            part.deregister_frame(frame_id)
        return part

    for name, count in (("1", 5), ("2", 8)):
        (states / name).mkdir(parents=True)
        first(count).write_binary(states / name)
    return [m.num_reg_images() for m in lost_model(states, [first(kept)] if kept else [], 8)]


@pytest.mark.parametrize(("kept", "restored"), [(0, [8]), (3, [8]), (7, []), (8, [])])
def test_a_model_that_mapping_discarded_late_is_its_last_saved_state(tmp_path, kept, restored):
    assert run_isolated(lost_after, tmp_path, kept) == restored
