"""Both pages in a browser: axe finds no barrier, and the scene fills the first screen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.reporting.index import Batch, index_html
from pipeline.reporting.page import write_report
from tests.browser import SECONDS, browser
from tests.reporting.made import report, trained
from tests.reporting.test_batch import BATCH

__all__ = ["browser"]

AXE = Path(__file__).parents[1] / "io" / "independent" / "node_modules" / "axe-core" / "axe.min.js"


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("kind", ["scene", "batch"])
def test_axe_finds_no_barrier_and_the_scene_is_on_the_first_screen(
    browser: Any, tmp_path: Path, kind: str, scheme: str, width: int
) -> None:
    """Contrast, names, roles and keyboard access; nothing is wider than the screen."""
    if not AXE.is_file():
        pytest.skip("not run: no axe-core (npm ci in tests/io/independent)")
    page_file = tmp_path / "index.html"
    if kind == "scene":
        write_report(report(trained=trained()), page_file)
    else:
        page_file.write_text(index_html(Batch(BATCH, stages=["decode", "train"])), "utf-8")
    size = {"width": width, "height": 844}
    with browser.new_context(viewport=size, color_scheme=scheme, bypass_csp=True) as context:
        context.set_default_timeout(1000 * SECONDS)
        page = context.new_page()
        page.goto(page_file.as_uri())
        if kind == "scene":
            page.evaluate("viewer.ready")
            tops = page.evaluate(
                "['#space', '.verdict strong', '.verdict dl'].map("
                "name => document.querySelector(name).getBoundingClientRect().bottom)"
            )
            assert max(tops) <= 844 and tops[0] > 844 / 2
            for name in ("Measure", "Crop"):
                page.get_by_role("button", name=name, exact=True).click()
        page.evaluate(AXE.read_text("utf-8"))
        found = page.evaluate("axe.run()")["violations"]
        assert [(v["id"], [node["html"] for node in v["nodes"]]) for v in found] == []
        assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_a_print_shows_the_poster_instead_of_the_viewer(browser: Any, tmp_path: Path) -> None:
    base = report(trained=trained())
    views = [replace(view, name=base.trained.views[0].name) for view in base.comparisons]
    write_report(replace(base, comparisons=views), tmp_path / "report.html")
    with browser.new_context(viewport={"width": 794, "height": 1123}) as context:
        context.set_default_timeout(1000 * SECONDS)
        page = context.new_page()
        page.goto((tmp_path / "report.html").as_uri())
        page.evaluate("viewer.ready")
        page.emulate_media(media="print")
        page.locator("#space .poster").wait_for(state="visible")
        assert not page.locator("#space canvas").is_visible()
        assert not page.locator(".tools").is_visible()
