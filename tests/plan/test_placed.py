"""A format that needs a place on the earth is refused before the run where there can be none."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.config.schema import Config
from pipeline.runtime.errors import UserError
from tests.plan.scans import many, plan_of
from tests.plan.test_early_checks import transforms
from tests.plans import make_plan

TILES = {"export": {"formats": ["tiles3d"]}}


def gps(i: int) -> tuple[float, float, float]:
    return (10 + i * 1e-4, 20.0, 100.0)


def test_gps_positions_can_place_a_scene(tmp_path: Path) -> None:
    make_plan(many(tmp_path / "s", 3, gps=gps), Config.model_validate(TILES))


def test_without_positions_or_with_the_georeference_off_the_error_says_what_to_give(
    tmp_path: Path,
) -> None:
    with pytest.raises(UserError, match=r"tiles3d needs .* it has none") as caught:
        make_plan(many(tmp_path / "s", 3), Config.model_validate(TILES))
    assert "gcp_list.txt" in str(caught.value.fix)
    make_plan(many(tmp_path / "s", 3), Config())
    off = Config.model_validate(TILES | {"sfm": {"georeference": "none"}})
    with pytest.raises(UserError, match="georeference is none"):
        make_plan(many(tmp_path / "s", 3, gps=gps), off)


@pytest.mark.parametrize("name", ["ortho", "laz"])
def test_maps_need_a_place_on_the_earth_and_stereo(tmp_path: Path, name: str) -> None:
    config = Config.model_validate({"export": {"formats": [name]}})
    with pytest.raises(UserError, match=f"{name} needs a scene with a place on the earth"):
        make_plan(many(tmp_path / "s", 3), config)
    plan = make_plan(many(tmp_path / "t", 3, gps=gps), config)
    assert plan.stages["dense"].run


def test_given_poses_have_a_world_of_their_own(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    transforms(folder)
    with pytest.raises(UserError, match="given poses"):
        plan_of(folder, **TILES)
