"""The page in a browser: no requests, renders as by our rasterizer, mouse and keyboard control."""

from __future__ import annotations

import base64
import io
import re
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from pipeline.io.splat_files import write_gaussians
from pipeline.render import RasterOptions
from pipeline.render.views import render_view
from pipeline.reporting.page import write_report
from pipeline.reporting.space import upright_camera
from pipeline.splats.arrays import collect
from pipeline.splats.axes import RUB, Flipped
from pipeline.splats.gaussians import Gaussians
from tests.reporting.made import gaussians, report, trained
from tests.tools import need_package

FLAGS = (
    *("--headless=new", "--no-sandbox", "--no-first-run"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
NAMES = ("chromium", "chromium-browser", "chromium-headless-shell", "chrome", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
SECONDS = 180.0  # a browser on a busy machine; a page is there within one or two on an idle one

Pixels = NDArray[np.uint8]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    need_package("playwright")
    if CHROMIUM is None:
        pytest.skip("not run: no Chromium (apt-get install chromium)")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=CHROMIUM, args=FLAGS, timeout=1000 * SECONDS
        )
        yield browser
        browser.close()


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """Small, because the browser renders on the CPU."""
    with browser.new_context(viewport={"width": 480, "height": 400}) as context:
        context.set_default_timeout(1000 * SECONDS)
        yield context.new_page()


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_report(report(trained=trained(gaussians=gaussians(1500))), path)
    return path


@pytest.fixture
def scene(page: Any, file: Path) -> Any:
    """The page with its scene loaded."""
    page.goto(file.as_uri())
    page.evaluate("viewer.ready")
    return page


def until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + SECONDS
    while not true():
        assert time.monotonic() < end, "it never came true"
        time.sleep(0.1)


def pixels(png: bytes) -> Pixels:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def canvas(page: Any) -> Pixels:
    return pixels(page.locator("#space canvas").screenshot())


def changed(page: Any, before: Pixels) -> None:
    until(lambda: not np.array_equal(canvas(page), before))


def settled(page: Any) -> Pixels:
    """The canvas once it has stopped changing: splats are sorted after they are first drawn."""
    seen = [canvas(page)]

    def still() -> bool:
        time.sleep(0.3)
        seen.append(canvas(page))
        return np.array_equal(seen[-1], seen[-2])

    until(still)
    return seen[-1]


def test_the_scene_appears_without_network_requests(page: Any, file: Path) -> None:
    asked: list[str] = []
    said: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.goto(file.as_uri())
    page.evaluate("viewer.ready")
    until(lambda: len(np.unique(canvas(page).reshape(-1, 3), axis=0)) > 2000)
    assert [url for url in asked if not url.startswith((file.as_uri(), "blob:", "data:"))] == []
    assert said == []
    assert not page.locator("#space p").is_visible()
    assert page.locator("#space-tools select").is_enabled()


@pytest.mark.parametrize(
    ("file", "antialias"), [(None, False), (None, True), ("scene.ply", False), ("scene.spz", False)]
)
def test_the_viewer_renders_as_our_rasterizer(
    page: Any, tmp_path: Path, file: str | None, antialias: bool
) -> None:
    """Spark's render of the page, or of a file of ours in its place, against the rasterizer's.

    Spark shows coordinates as they are in a file: y up for SPZ, y down for PLY.
    """
    path = tmp_path / "report.html"
    scene = trained(gaussians=gaussians(3000), background=(0.2, 0.5, 1.0), antialias=antialias)
    write_report(report(trained=scene), path)
    shown = Gaussians.sharing(scene.gaussians)
    if file is not None:
        write_gaussians(tmp_path / file, shown)
        text = base64.b64encode((tmp_path / file).read_bytes()).decode()
        path.write_text(re.sub(r'(?<=id="splats">)[^<]+', text, path.read_text("utf-8")), "utf-8")
    if file == "scene.spz":
        shown = Gaussians.sharing(collect(Flipped(shown, RUB)))
    page.goto(path.as_uri())
    for view in scene.views[:3]:
        url = page.evaluate("camera => viewer.picture(camera)", upright_camera(view, 1))
        drawn = pixels(base64.b64decode(url.partition(",")[2]))
        options = RasterOptions(background=scene.background, antialias=antialias, near=scene.near)
        ours = render_view(shown, view, options).rgb
        assert drawn.shape == ours.shape
        psnr = -10 * np.log10(np.mean((drawn / 255 - np.rint(ours * 255) / 255) ** 2))
        assert psnr >= 38


def test_the_slider_moves_between_photograph_and_render(scene: Any) -> None:
    scene.get_by_label("Slider").focus()
    scene.keyboard.press("Space")
    slider = scene.locator(".triple input").first
    triple = scene.locator(".triple").first

    def shown() -> Pixels:
        return pixels(triple.screenshot())

    slider.focus()
    scene.keyboard.press("Home")
    render = shown()
    scene.keyboard.press("End")
    photograph = shown()
    for _ in range(5):
        scene.keyboard.press("PageDown")
    assert 0 < float(slider.input_value()) < 100
    middle = shown()
    half = middle.shape[1] // 8
    assert not np.array_equal(render[:, :half], photograph[:, :half])
    assert not np.array_equal(middle, render) and not np.array_equal(middle, photograph)
    x, y, width, height = (slider.bounding_box()[key] for key in ("x", "y", "width", "height"))
    scene.mouse.click(x + width / 4, y + height / 2)
    assert float(slider.input_value()) == pytest.approx(25, abs=3)


def test_views_cameras_and_points_can_be_chosen(scene: Any) -> None:
    first = settled(scene)
    tools = scene.locator("#space-tools")
    assert tools.locator("select").input_value() == "2"
    tools.get_by_role("button", name="next view").click()
    assert tools.locator("select").input_value() == "3"
    changed(scene, first)
    tools.locator("select").select_option("overview")
    changed(scene, first)
    afar = settled(scene)
    tools.get_by_label("Cameras").uncheck()
    changed(scene, afar)
    bare = settled(scene)
    tools.get_by_text("Sparse points").click()
    changed(scene, bare)
    tools.get_by_text("Gaussians").click()
    until(lambda: np.array_equal(canvas(scene), bare))
    tools.get_by_label("Cameras").check()
    until(lambda: np.array_equal(canvas(scene), afar))


def test_mouse_wheel_and_keys_turn_and_zoom(scene: Any) -> None:
    still = settled(scene)
    scene.evaluate("document.getElementById('space').scrollIntoView({behavior: 'instant'})")
    top = scene.evaluate("scrollY")
    area = scene.locator("#space canvas").bounding_box()
    x, y = area["x"] + area["width"] / 2, area["y"] + area["height"] / 2
    scene.mouse.move(x, y)
    scene.mouse.wheel(0, 40)
    until(lambda: scene.evaluate("scrollY") > top)  # the page's, until the scene is clicked
    scene.mouse.down()
    scene.mouse.move(x + 60, y + 10, steps=3)
    scene.mouse.up()
    changed(scene, still)
    turned = settled(scene)
    top = scene.evaluate("scrollY")
    scene.mouse.wheel(0, 200)
    changed(scene, turned)
    assert scene.evaluate("scrollY") == top
    zoomed = settled(scene)
    scene.keyboard.press("ArrowLeft")
    changed(scene, zoomed)


def test_without_webgl_the_page_shows_a_message(page: Any, file: Path) -> None:
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(file.as_uri())
    said = page.locator("#space p")
    until(lambda: "this browser has no WebGL2" in said.inner_text())
    assert page.locator("#space-tools select").is_disabled()
    assert page.locator("#pictures").is_visible()
