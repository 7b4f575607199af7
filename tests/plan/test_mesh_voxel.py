"""Voxels that cannot suit the scene are reported before the training, not after it."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.config.schema import Config
from pipeline.plan.values import Plan
from pipeline.runtime.errors import UserError
from tests.pictures import photos
from tests.plan.scans import many, plan_of
from tests.plan.test_early_checks import transforms
from tests.plans import make_plan


def mesh(voxel: float | None, *formats: str) -> dict[str, object]:
    return {"formats": formats or ("mesh",), "mesh_voxel": voxel}


def said(plan: Plan) -> str:
    return "\n".join(plan.stages["export"].decisions)


@pytest.mark.parametrize("scene", ["level", "given"])
def test_voxels_are_compared_with_the_extent_of_the_cameras(tmp_path: Path, scene: str) -> None:
    """Given cameras are 3 units apart; without poses, the unit follows from the cameras."""
    folder = tmp_path / "s"
    if scene == "given":
        transforms(folder)
    else:
        photos(folder / "images", 4)
    assert said(plan_of(folder, export=mesh(None))) == ""
    assert said(plan_of(folder, export=mesh(0.01))) == ""
    assert "24 million" in said(plan_of(folder, export=mesh(1e-9)))
    assert said(plan_of(folder, export=mesh(1e-9, "ply"))) == "", "no mesh is written"
    with pytest.raises(UserError, match=r"export\.mesh_voxel: expected voxels smaller than"):
        plan_of(folder, export=mesh(1e6))


@pytest.mark.parametrize("metres", [30.0, 30_000.0])
def test_the_extent_by_gps_is_in_metres(tmp_path: Path, metres: float) -> None:
    degrees = metres / 111_195
    scan = many(tmp_path / "s", 3, gps=lambda i: (10 + i * degrees / 2, 20.0, None))

    def planned(voxel: float) -> str:
        return said(make_plan(scan, Config.model_validate({"export": mesh(voxel)})))

    assert planned(metres / 200) == ""
    assert f"within {metres:.3g} m (GPS)" in planned(metres / 1e5)
    with pytest.raises(UserError, match=r"m \(GPS\)"):
        planned(metres * 2000)
