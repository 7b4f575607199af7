"""The rasterizer's benchmark runs what training runs, against the machine's own peak."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.measured import measured
from benchmarks.raster.drawing import drawings
from benchmarks.raster.library import heading, library_facts, measured_library
from benchmarks.raster.measure import Step
from benchmarks.raster.peak import Calibration, Peak
from benchmarks.raster.scenes import synthetic, trained
from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import write_model
from pipeline.io.ply import write_splat_ply
from pipeline.scene.reconstruction import PosedImage, Reconstruction
from pipeline.splats.gaussians import Gaussians


def test_every_operator_of_a_step_is_timed() -> None:
    times = Step(synthetic(500, 96, 54, 5.0), threads=2).once()
    parts = [name for name in times if name != "step"]
    assert len(parts) == 6
    assert times["step"].wall == sum(times[name].wall for name in parts) > 0


def test_the_peak_is_of_the_widest_instructions_of_the_processor() -> None:
    """Not of those that the kernels are compiled for, which may be narrower, never wider."""
    peak, library = Calibration().peak(1), measured_library()
    assert peak.lanes >= library.lanes
    assert peak.flops > 0 and peak.bytes > 0 and peak.clock > 0
    assert peak.instruction_set in str(peak)


def test_an_impossible_rate_is_reported() -> None:
    peak = Peak(2, 2 * 2 * 8 * 2 * 3e9, 1e9, "AVX2", 8, True, 3e9)
    assert peak.per_cycle == pytest.approx(2)
    assert peak.plausible and "warning" not in str(peak)
    slow = replace(peak, flops=0.75 * peak.flops)
    assert not slow.plausible and "warning" in str(slow)


def test_tables_and_records_say_what_was_measured() -> None:
    library = measured_library()
    facts = measured("raster", "")
    for text in (facts.processor, library.instruction_set, library.compiler):
        assert text and text in heading(library)
    assert facts.instruction_set == library_facts(library)["target"] == library.target
    assert facts.compiler == library.compiler


def test_half_of_the_gaussians_can_be_out_of_view() -> None:
    found = drawings(synthetic(2000, 96, 54, 1.0, in_view=0.5), [1, 2], seconds=0.0)
    assert [drawing.threads for drawing in found] == [1, 2]
    assert 0.45 < found[0].visible / 2000 < 0.6


def test_a_trained_scene_is_drawn_from_its_views_at_any_size(tmp_path: Path) -> None:
    scene = synthetic(50, 96, 54, 5.0)
    write_splat_ply(tmp_path / "point_cloud.ply", Gaussians(*scene.gaussians))
    camera = Camera("PINHOLE", 96, 54, np.array([115.2, 115.2, 48.0, 27.0]))
    images = {
        i: PosedImage(f"{i:03}.png", 1, np.eye(3), np.array([0.01 * i, 0.0, 0.0]))
        for i in range(1, 41)
    }
    write_model(tmp_path / "sparse" / "0", Reconstruction({1: camera}, images))
    own = trained(tmp_path)
    assert (own.camera.width, own.camera.height) == (96, 54)
    larger = trained(tmp_path, (192, 108))
    assert len(larger.views) == 16
    assert larger.views[0].fx == pytest.approx(2 * 115.2)
    drawn = drawings(larger, [1], seconds=0.0)[0]
    assert drawn.views == 16 and drawn.visible > 40
