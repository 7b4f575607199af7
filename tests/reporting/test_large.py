"""The page of a scene with more Gaussians than it has: some at once, all from a web server."""

from __future__ import annotations

import base64
import functools
import http.server
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.render import RasterOptions
from pipeline.render.views import render_view
from pipeline.reporting.page import write_report
from pipeline.reporting.space import upright_camera
from pipeline.splats.gaussians import Gaussians
from tests.browser import browser
from tests.reporting.made import gaussians, report, trained
from tests.reporting.test_viewer import page, pixels

__all__ = ["browser", "page"]

SCENE = trained(gaussians=gaussians(3000))


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files without a log."""

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A page with 300 of 3000 Gaussians, and the file with all."""
    for module in ("fit", "space"):
        monkeypatch.setattr(f"pipeline.reporting.{module}.MAX_GAUSSIANS", 300)
    write_report(report(trained=SCENE), tmp_path / "report" / "report.html")
    (tmp_path / "report" / "report.html").replace(tmp_path / "report.html")
    return tmp_path


@pytest.fixture
def address(folder: Path) -> Iterator[str]:
    handler = functools.partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/report.html"
        server.shutdown()


def psnr(page: Any) -> float:
    """Of the viewer against the rasterizer with all Gaussians, dB."""
    view = SCENE.views[1]
    url = page.evaluate("camera => viewer.picture(camera)", upright_camera(view, 1))
    drawn = pixels(base64.b64decode(url.partition(",")[2]))
    options = RasterOptions(background=SCENE.background, near=SCENE.near)
    ours = render_view(Gaussians.sharing(SCENE.gaussians), view, options).rgb
    return float(-10 * np.log10(np.mean((drawn / 255 - np.rint(ours * 255) / 255) ** 2)))


def test_all_gaussians_are_loaded_from_a_web_server(page: Any, address: str) -> None:
    """Cropping counts them too."""
    page.goto(address)
    page.evaluate("viewer.full")
    assert page.locator("#space-full").inner_text() == "All of them are shown."
    assert psnr(page) >= 35
    page.get_by_role("button", name="Crop").click()
    assert int(page.locator(".crop .count").inner_text().split()[0].replace(",", "")) > 1000


def test_a_page_from_a_file_shows_some_and_says_how_to_see_all(page: Any, folder: Path) -> None:
    page.goto((folder / "report.html").as_uri())
    page.evaluate("viewer.full")
    assert "when the page is on a web server" in page.locator("#space-full").inner_text()
    assert psnr(page) < 35


def test_a_missing_file_leaves_the_page_as_it_is(page: Any, folder: Path, address: str) -> None:
    (folder / "report" / "scene.spz").unlink()
    page.goto(address)
    page.evaluate("viewer.full")
    assert "could not be loaded" in page.locator("#space-full").inner_text()
    assert page.locator("#space-tools select").is_enabled()
