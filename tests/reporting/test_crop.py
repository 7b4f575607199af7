"""Cropping in the page's viewer: what it shows is what the options that it gives back export."""

from __future__ import annotations

import base64
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pipeline.command.main import make_parser
from pipeline.config.export import Export
from pipeline.export.selection import in_box, select_gaussians, subject_box
from pipeline.render import RasterOptions
from pipeline.render.views import render_view
from pipeline.reporting.page import write_report
from pipeline.reporting.space import upright_camera
from pipeline.scene.normalization import Normalization
from pipeline.splats.gaussians import Gaussians
from tests.reporting.made import gaussians, report, trained
from tests.reporting.test_viewer import browser, page, pixels, state

__all__ = ["browser", "page"]


def test_the_options_given_back_export_exactly_what_is_shown(page: Any, tmp_path: Path) -> None:
    """In the unit of exported files, of which the world has two."""
    scene = trained(gaussians=gaussians(3000), normalization=Normalization(2.0))
    write_report(report(trained=scene), tmp_path / "report.html")
    page.goto((tmp_path / "report.html").as_uri())
    page.evaluate("viewer.ready")
    page.get_by_role("button", name="Crop").click()
    subject = np.array(subject_box(scene.gaussians, scene.views)) / 2
    np.testing.assert_allclose(state(page)["crop"], subject, atol=0.011)
    for name in ("x from", "z to"):
        slider = page.get_by_label(name)
        slider.focus()
        page.keyboard.press("PageUp" if name == "x from" else "PageDown")
    options = yaml.safe_load(page.get_by_label("For config/config.yaml").input_value())
    region = Export.model_validate(options["export"]).region
    assert list(region) == state(page)["crop"] and region[0] > subject[0] + 0.05
    exported = scene.gaussians.scaled(0.5)
    chosen = select_gaussians(exported, None, region, [], RasterOptions()).gaussians
    assert 100 < len(chosen) < 2500
    assert page.locator(".crop .count").inner_text() == f"{len(chosen):,} Gaussians in the box"
    kept = Gaussians.sharing(chosen.scaled(2))
    for view in scene.views[:2]:
        url = page.evaluate("camera => viewer.picture(camera)", upright_camera(view, 1))
        drawn = pixels(base64.b64decode(url.partition(",")[2]))
        ours = render_view(kept, view, RasterOptions(background=(0, 0, 0), near=scene.near)).rgb
        assert -10 * np.log10(np.mean((drawn / 255 - np.rint(ours * 255) / 255) ** 2)) >= 38
    command = page.get_by_label("For the exported file").input_value()
    box = make_parser().parse_args(shlex.split(command)[1:]).box
    np.testing.assert_array_equal(in_box(exported.means, box), in_box(exported.means, region))
    page.get_by_role("button", name="Crop").click()
    assert state(page)["crop"] is None and not page.locator("#space .crop").is_visible()


def test_faces_do_not_pass_each_other_and_are_copied(page: Any, tmp_path: Path) -> None:
    write_report(report(trained=trained()), tmp_path / "report.html")
    page.goto((tmp_path / "report.html").as_uri())
    page.evaluate("viewer.ready")
    page.get_by_role("button", name="Crop").click()
    for name, key in [("y from", "End"), ("z to", "Home")]:
        page.get_by_label(name).focus()
        page.keyboard.press(key)
    box = state(page)["crop"]
    Export.model_validate({"region": box})
    assert box[4] - box[1] < 0.011 and box[5] - box[2] < 0.011
    page.get_by_role("button", name="Copy options").click()
    field = page.get_by_label("For config/config.yaml")
    assert (
        field.evaluate(
            "f => document.getSelection().toString() || f.value.slice("
            "f.selectionStart, f.selectionEnd)"
        )
        == field.input_value()
    )
