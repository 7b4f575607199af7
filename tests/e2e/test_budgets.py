"""A finished scene as a point of quality by training time."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.budgets.points import Setup, measured_point
from tests.e2e.harness import metrics

pytestmark = pytest.mark.slow


def test_a_finished_run_is_a_point(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Setup, "results", lambda *_: finished / "results" / "tiny")
    point = measured_point(Setup(Path(), Path(), {}, 1), "tiny", 0, 1.0)
    found = metrics(finished, "tiny")
    assert (point.psnr, point.ssim) == (found["psnr"], found["ssim"])
    assert (point.steps, point.gaussians) == (240, found["num_gaussians"])
    assert point.pixels == ", ".join(found["protocol"]["resolution"])
    assert point.cpu_minutes > 0 and point.other_cpu_minutes > 0
