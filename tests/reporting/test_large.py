"""The page of a scene with more Gaussians than it has: some at once, all from a web server."""

from __future__ import annotations

import base64
import functools
import http.server
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.render import RasterOptions
from pipeline.render.views import render_view
from pipeline.reporting.page import write_report
from pipeline.reporting.space import upright_camera
from pipeline.splats.gaussians import Gaussians
from tests.browser import SECONDS, browser
from tests.reporting.made import gaussians, report, trained
from tests.reporting.test_viewer import canvas, page, pixels

__all__ = ["browser", "page"]

# More Gaussians than the viewer draws in one batch.
SCENE = trained(gaussians=gaussians(9000))


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files without a log."""

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A page with 300 of 9000 Gaussians, of which it shows 100 merged ones first, and the file with
    all."""
    for module in ("fit", "space"):
        monkeypatch.setattr(f"pipeline.reporting.{module}.MAX_GAUSSIANS", 300)
    monkeypatch.setattr("pipeline.reporting.fit.FIRST_GAUSSIANS", 100)
    write_report(report(trained=SCENE), tmp_path / "report" / "report.html")
    (tmp_path / "report" / "report.html").replace(tmp_path / "report.html")
    return tmp_path


@contextmanager
def served(handler: Callable[..., Any]) -> Iterator[str]:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/report.html"
        server.shutdown()


@pytest.fixture
def address(folder: Path) -> Iterator[str]:
    with served(functools.partial(Quiet, directory=str(folder))) as address:
        yield address


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


def test_the_first_picture_is_drawn_before_the_full_file_is_fetched(
    page: Any, address: str
) -> None:
    page.goto(address)
    page.evaluate("viewer.full")
    entries = page.evaluate(
        "performance.getEntries().filter(({ name, entryType }) =>"
        " entryType === 'mark' || name.endsWith('scene.spz')).map(({ name }) => name)"
    )
    file = address.replace("report.html", "report/scene.spz")
    assert entries == ["first picture", "the page's Gaussians", file, "all Gaussians"]


def test_the_first_picture_needs_only_the_beginning_of_the_page(page: Any, folder: Path) -> None:
    """The rest can still be on its way, as over a slow network."""
    start, found, rest = (folder / "report.html").read_bytes().partition(b'id="splats-fine"')
    assert found
    go_on = threading.Event()

    class Slow(Quiet):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(start)
            self.wfile.flush()
            go_on.wait(SECONDS)
            self.wfile.write(found + rest)

    with served(Slow) as address:
        try:
            page.goto(address, wait_until="commit")
            page.locator("#space.shown").wait_for()
            assert page.evaluate("document.readyState") == "loading"
            assert not page.get_by_role("button", name="Measure").is_visible()
            assert len(np.unique(canvas(page).reshape(-1, 3), axis=0)) > 500
        finally:
            go_on.set()
        page.evaluate("viewer.ready")
        assert page.get_by_role("button", name="Measure").is_visible()


def test_a_slow_device_draws_fewer_pixels_and_a_fast_one_all(page: Any, folder: Path) -> None:
    """A device on which a frame takes 20 ms per thousand pixels, and one that takes no time."""
    page.add_init_script("""
        window.slowness = 0.02;
        const context = WebGL2RenderingContext.prototype, { fenceSync, getSyncParameter } = context;
        context.fenceSync = function (...given) {
            const fence = fenceSync.apply(this, given);
            const pixels = this.drawingBufferWidth * this.drawingBufferHeight;
            fence.end = performance.now() + pixels * window.slowness;
            return fence;
        };
        context.getSyncParameter = function (fence, name) {
            return performance.now() < fence.end ? this.UNSIGNALED : this.SIGNALED;
        };""")
    page.goto((folder / "report.html").as_uri())
    page.evaluate("viewer.ready")
    share = "document.querySelector('#space canvas').width / document.body.clientWidth"
    page.evaluate("viewer.settled()")
    assert 0.2 < page.evaluate(share) < 0.9
    page.evaluate("slowness = 0")
    page.evaluate("viewer.settled()")
    page.evaluate("viewer.settled()")
    assert page.evaluate(share) == 1


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
