"""A weak model is adjusted as far as the photographs determine it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.judge import cases, world
from pipeline.io.colmap import read_model
from pipeline.metrics.pose import pose_error
from pipeline.runtime.isolate import run_isolated


def refine_case(folder: Path, case: str, prior: float | None) -> dict[str, Any]:
    """Map a synthetic capture without EXIF, and refine it with a focal length from EXIF of
    ``prior`` times the true one."""
    from pipeline.sfm.mappers import run_mapper
    from pipeline.sfm.models import quiet_colmap, write_model
    from pipeline.sfm.weak import refine_weak

    quiet_colmap()
    written = world.write(cases.make(case, 0), folder / "database.db", 0)
    model = run_mapper("incremental", folder / "database.db", len(written.manifest.photos), 0)[0]
    priors = {} if prior is None else dict.fromkeys(model.cameras, prior * world.FOCAL)
    refined = refine_weak(model, priors)
    found: dict[str, Any] = {"decision": refined.decisions[0]}
    for name, each in (("before", model), ("after", refined.model)):
        write_model(each, folder / name)
        error = pose_error(read_model(folder / name), written.truths[0])
        (camera,) = each.cameras.values()
        found[name] = (
            each.compute_mean_reprojection_error(),
            error.rotation_median_deg,
            camera.mean_focal_length() / world.FOCAL,
        )
    return found


@pytest.mark.parametrize(
    ("case", "prior", "text"),
    [
        ("planar", None, "those of mapping"),
        ("planar", 1.0, "those of EXIF"),
        ("planar", 1.2, "those of mapping"),
        ("orbit", 2.0, "principal points fixed"),
    ],
)
def test_poses_improve_and_focal_lengths_follow_what_determines_them(tmp_path, case, prior, text):
    found = run_isolated(refine_case, tmp_path, case, prior)
    (error, rotation, focal), (error_after, rotation_after, focal_after) = (
        found["before"],
        found["after"],
    )
    assert text in found["decision"]
    assert error_after < error and rotation_after < (0.6 if "EXIF" in text else 1.1) * rotation
    if "EXIF" in text:
        assert focal_after == pytest.approx(1.0)
    elif "mapping" in text:
        assert focal_after == focal
    else:
        assert focal_after == pytest.approx(1.0, abs=0.01) and focal_after != focal
