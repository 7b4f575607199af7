"""The page in a browser: no requests, renders as by our rasterizer, mouse, touch and keyboard."""

from __future__ import annotations

import base64
import dataclasses
import io
import re
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
from tests.browser import SECONDS, browser
from tests.reporting.made import gaussians, report, trained
from tests.reporting.worlds import WORLDS, World

__all__ = ["browser"]

Pixels = NDArray[np.uint8]


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """Small, because the browser renders on the CPU; cameras are reached without a flight."""
    size = {"width": 480, "height": 400}
    with browser.new_context(viewport=size, reduced_motion="reduce") as context:
        context.set_default_timeout(1000 * SECONDS)
        yield context.new_page()


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    base = report(trained=trained(gaussians=gaussians(1500)))
    red = np.full_like(base.comparisons[0].photograph, (255, 0, 0))
    shown = dataclasses.replace(
        base.comparisons[0], label="median", name="2.jpg", photograph=red, mask=None
    )
    write_report(dataclasses.replace(base, comparisons=[shown, *base.comparisons]), path)
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
    """Without the texts over it and its edge, which depend on where the page is scrolled to."""
    style = "#space :is(.bar, .corner, .activate) { visibility: hidden; }"
    return pixels(page.locator("#space canvas").screenshot(style=style))[2:-2, 2:-2]


def changed(page: Any, before: Pixels) -> None:
    until(lambda: not np.array_equal(canvas(page), before))


def settled(page: Any) -> Pixels:
    """The canvas once it has stopped changing: splats are sorted after they are first drawn."""
    page.evaluate("viewer.settled()")
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
    assert not page.locator("#space .message").is_visible()
    assert page.locator("#space-tools select").is_enabled()


@pytest.mark.parametrize(
    ("file", "antialias", "around"),
    [
        (None, False, False),
        (None, True, False),
        (None, False, True),
        ("scene.ply", False, False),
        ("scene.spz", False, False),
    ],
)
def test_the_viewer_renders_as_our_rasterizer(
    page: Any, tmp_path: Path, file: str | None, antialias: bool, around: bool
) -> None:
    """Spark's render of the page, or of a file of ours in its place, against the rasterizer's; also
    of large Gaussians around, beside and behind the cameras.

    Spark shows coordinates as they are in a file: y up for SPZ, y down for PLY.
    """
    path = tmp_path / "report.html"
    made = gaussians(150 if around else 3000)
    if around:
        made.means[:] *= 5
        made.log_scales[:] += 3
    scene = trained(gaussians=made, background=(0.2, 0.5, 1.0), antialias=antialias)
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
    width, height = (slider.bounding_box()[key] for key in ("width", "height"))
    # A click of the element waits until its place is stable.
    slider.click(position={"x": width / 4, "y": height / 2})
    assert float(slider.input_value()) == pytest.approx(25, abs=3)


def test_views_cameras_and_points_can_be_chosen(scene: Any) -> None:
    first = settled(scene)
    tools = scene.locator("#space-tools")
    view = tools.locator("select")
    assert view.input_value() == "2"
    scene.get_by_role("button", name="next camera").click()
    assert view.input_value() == "3" and scene.locator("#space .name").inner_text() == "3.jpg"
    changed(scene, first)
    scene.get_by_role("button", name="Reset").click()
    assert view.input_value() == "2"
    view.select_option("overview")
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


def test_pyramids_are_drawn_at_a_camera_too(scene: Any) -> None:
    """Those of the other cameras, however near they are."""
    scene.get_by_role("button", name="next camera").click()  # Without a photograph over it.
    bare = settled(scene)
    scene.locator("#space-tools").get_by_label("Cameras").check()
    changed(scene, bare)


def state(page: Any) -> dict[str, Any]:
    return page.evaluate("viewer.state()")


def test_the_wheel_is_the_pages_until_the_scene_is_clicked(scene: Any) -> None:
    scene.evaluate("document.getElementById('space').scrollIntoView({behavior: 'instant'})")
    area = scene.locator("#space canvas").bounding_box()
    x, y = area["x"] + area["width"] / 4, area["y"] + area["height"] / 4

    def wheel(*, scrolls: bool) -> None:
        top, pose = scene.evaluate("scrollY"), state(scene)["pose"]
        scene.mouse.wheel(0, 30)
        if scrolls:
            until(lambda: scene.evaluate("scrollY") > top)
        else:
            until(lambda: state(scene)["pose"] != pose)
        assert (scene.evaluate("scrollY") > top) == scrolls
        assert (state(scene)["pose"] != pose) != scrolls

    scene.mouse.move(x, y)
    wheel(scrolls=True)
    scene.keyboard.down("Control")
    wheel(scrolls=False)
    scene.keyboard.up("Control")
    scene.mouse.click(x, y)
    assert state(scene)["active"]
    wheel(scrolls=False)
    scene.keyboard.press("Escape")
    wheel(scrolls=True)
    scene.mouse.click(x, y)
    scene.get_by_role("button", name="Done").click()
    scene.mouse.move(x, y)
    wheel(scrolls=True)


def test_keys_walk_turn_zoom_and_reset(scene: Any) -> None:
    start = state(scene)
    scene.locator("#space canvas").focus()
    for key, current in [("ArrowRight", 3), ("ArrowLeft", 2), ("ArrowLeft", 1), ("Home", 2)]:
        scene.keyboard.press(key)
        assert state(scene)["current"] == current
    assert state(scene) == start
    for key in ("Shift+ArrowLeft", "Shift+ArrowUp", "ArrowUp", "-"):
        before = state(scene)["pose"]
        scene.keyboard.press(key)
        assert state(scene)["pose"] != before, key


def test_the_divider_in_the_viewer_uncovers_the_render(scene: Any) -> None:
    """The photograph is red, lies over its camera's image, and goes when the view turns."""
    slider = scene.locator("#space .photograph input")

    def reds() -> Pixels:
        return (np.abs(settled(scene).astype(int) - (255, 0, 0)) < 16).all(2)

    half = reds()
    left, right = np.array_split(half, 2, axis=1)
    assert left.mean() > 0.5 and right.mean() < 0.1
    slider.focus()
    scene.keyboard.press("End")
    assert reds().mean() > 0.8
    area = scene.locator("#space").bounding_box()
    x, y = area["x"] + area["width"] / 4, area["y"] + area["height"] / 4
    scene.mouse.move(x, y)
    scene.mouse.down()
    scene.mouse.move(x + 20, y, steps=2)
    scene.mouse.up()
    assert state(scene)["photograph"] is None and not reds().any()
    scene.get_by_role("button", name="Reset").click()
    assert state(scene)["photograph"] == "2.jpg"


def test_one_finger_scrolls_the_page_until_the_scene_is_tapped(browser: Any, file: Path) -> None:
    size = {"width": 390, "height": 700}
    with browser.new_context(
        viewport=size, has_touch=True, is_mobile=True, reduced_motion="reduce"
    ) as context:
        context.set_default_timeout(1000 * SECONDS)
        page = context.new_page()
        page.goto(file.as_uri())
        page.evaluate("viewer.ready")
        page.add_style_tag(content="html { scroll-behavior: auto !important }")
        page.evaluate("document.getElementById('space').scrollIntoView({block: 'center'})")
        touch = context.new_cdp_session(page)

        def swipe() -> tuple[bool, bool]:
            """Up across the scene: whether the page scrolled, and whether the view turned."""
            area = page.locator("#space").bounding_box()
            top, pose = page.evaluate("scrollY"), state(page)["pose"]
            x, y = area["x"] + 60, area["y"] + area["height"] / 2
            for i in range(8):
                kind, point = "touchMove" if i else "touchStart", {"x": x, "y": y - 12 * i}
                touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [point]})
            touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
            time.sleep(0.5)
            return page.evaluate("scrollY") > top, state(page)["pose"] != pose

        assert swipe() == (True, False)
        area = page.locator("#space").bounding_box()
        page.touchscreen.tap(area["x"] + 60, area["y"] + area["height"] / 2)
        until(lambda: state(page)["active"])
        assert swipe() == (False, True)
        page.get_by_role("button", name="Done").tap()
        assert swipe() == (True, False)
        assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]


GESTURES = Path(__file__).with_name("gestures.js").read_text("utf-8")
Random = np.random.Generator


def gesture(rng: Random) -> dict[str, Any]:
    """A gesture on the canvas: its kind, and numbers between -1 and 1."""
    kinds = ("drag", "drag", "pan", "wheel", "swipe", "tap", "double", "key")
    return {"kind": str(rng.choice(kinds)), "values": rng.uniform(-1, 1, 6).round(4).tolist()}


def load_world(page: Any, tmp_path: Path, world: World) -> None:
    path = tmp_path / "report.html"
    write_report(report(trained=world.scene), path)
    page.goto(path.as_uri())
    page.evaluate("viewer.ready")
    page.add_script_tag(content=GESTURES)


def in_world(page: Any, world: World, seen: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """The viewpoint, and the depths of the subject's points that are in the canvas."""
    data = page.evaluate("JSON.parse(document.getElementById('space-data').textContent).frame")
    frame = np.linalg.inv(np.array(data).reshape(4, 4).T)
    pose = frame @ np.array(seen["pose"]).reshape(4, 4).T
    scale = np.cbrt(np.linalg.det(pose[:3, :3]))
    local = (world.subject - pose[:3, 3]) @ (pose[:3, :3] / scale)
    depth, tangent = -local[:, 2], np.tan(np.radians(seen["fov"]) / 2)
    ahead = depth > 0.03
    up, aside = (np.abs(local[ahead, axis]) / depth[ahead] / tangent for axis in (1, 0))
    aspect = seen["aspect"]
    return pose[:3, 3], depth[ahead][(up < 1) & (aside < aspect)]


@pytest.mark.parametrize("world", WORLDS, ids=lambda world: world.name)
def test_no_gesture_loses_the_subject(page: Any, tmp_path: Path, world: World) -> None:
    """200 random gestures: the subject stays in view at a sensible distance, the viewpoint where
    photographs could have been taken, and no view is flat."""
    load_world(page, tmp_path, world)
    rng = np.random.default_rng(7)
    for _ in range(4):
        made = [gesture(rng) for _ in range(50)]
        for done, seen in zip(made, page.evaluate("gestures => play(gestures)", made), strict=True):
            viewpoint, depths = in_world(page, world, seen)
            assert world.allows(viewpoint), (done, viewpoint)
            assert len(depths) >= 10, (done, viewpoint)
            assert 0.2 * world.distance < np.median(depths) < 1.8 * world.distance, done
        picture = settled(page).reshape(-1, 3).astype(int)
        common = np.median(picture, axis=0)
        assert (np.abs(picture - common).max(1) <= 8).mean() < 0.8


@pytest.mark.parametrize("world", WORLDS, ids=lambda world: world.name)
def test_one_orbits_as_far_as_the_photographs_reach(
    page: Any, tmp_path: Path, world: World
) -> None:
    """All round an object; a facade or a wall from its front only."""
    load_world(page, tmp_path, world)
    drags = [{"kind": "drag", "values": [0, 0, way, 0, 0, 0]} for way in (0.3, -0.3)]
    made = [drags[0]] * 12 + [drags[1]] * 24
    states = page.evaluate("gestures => play(gestures)", made)
    towards = np.array([np.subtract(s["pose"][12:15], s["pivot"]) for s in states])
    angles = np.unwrap(np.arctan2(towards[:, 0], towards[:, 2]))
    turned = np.degrees(np.ptp(angles))
    low, high = world.turn
    assert low <= turned <= high


def test_without_webgl_the_page_shows_a_message(page: Any, file: Path) -> None:
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(file.as_uri())
    said = page.locator("#space .message")
    until(lambda: "this browser has no WebGL2" in said.inner_text())
    assert page.locator("#space-tools select").is_disabled()
    assert page.locator("#space .poster").evaluate("poster => poster.naturalWidth") > 0
    assert page.locator("#pictures").is_visible()
