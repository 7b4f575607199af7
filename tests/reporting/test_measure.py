"""Measuring in the page's viewer: known sizes of the demo scene, by mouse and by keyboard."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.demo.scene import OBJECTS, ROOM, trace
from pipeline.geometry.rotations import rotation_to_quat
from pipeline.reporting.data import TrainedScene
from pipeline.reporting.page import write_report
from pipeline.scene.normalization import Normalization
from pipeline.scene.views import View
from pipeline.splats.arrays import GaussianArrays
from tests.browser import browser
from tests.reporting.made import report
from tests.reporting.test_viewer import page, state
from tests.reporting.worlds import look_at

__all__ = ["browser", "page"]

Array = NDArray[np.float64]

# On the floor, the cap of the cylinder in the middle, and the tops of a box and another cylinder.
FLOOR, CAP, BOX, COLUMN = (
    (0.8, -0.7, 0.0),
    (0.26, -0.28, 0.38),
    (0.95, 0.03, 0.56),
    (-0.9, -0.5, 0.75),
)
EYE = (0.4, -3.0, 1.8)
STEP = 0.7  # pixels between the rays whose hits become Gaussians


def rays(view: View, step: float) -> Array:
    """(3, N) directions of pixels ``step`` apart."""
    x, y = np.meshgrid(np.arange(0, view.width, step), np.arange(0, view.height, step))
    local = np.stack([(x - view.cx) / view.fx, (y - view.cy) / view.fy, np.ones_like(x)])
    return np.asarray(view.world_to_camera[:3, :3].T @ local.reshape(3, -1))


def surface_of_the_demo(view: View) -> GaussianArrays:
    """Opaque discs on what a view of the demo sees, one for each ray."""
    direction, origin = rays(view, STEP), view.centre[:, None]
    depth, index = trace(origin, direction, OBJECTS)
    points = origin + depth * direction
    normals = np.empty_like(points)
    for i, shape in [(-1, ROOM), *enumerate(item.shape for item in OBJECTS)]:
        normals[:, index == i] = shape.normal(points[:, index == i])
    aside = np.cross(normals.T, [0.3, 0.5, 0.8])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    axes = np.stack([aside, np.cross(normals.T, aside), normals.T], axis=2)
    size = STEP * depth / view.fx / np.sqrt(np.abs((normals * direction).sum(0)).clip(0.1))
    count = points.shape[1]
    return GaussianArrays(
        means=points.T.astype(np.float32),
        log_scales=np.log(size[:, None] * [0.7, 0.7, 0.02]).astype(np.float32),
        quats=rotation_to_quat(axes).astype(np.float32),
        opacity_logits=np.full(count, 3.0, np.float32),
        sh=np.random.default_rng(0).normal(0, 1, (count, 1, 3)).astype(np.float32),
    )


def load_demo(page: Any, tmp_path: Path, **changes: Any) -> View:
    """A page with one camera of the demo, which is shown; returns the camera."""
    view = look_at(EYE, (0.1, 0.0, 0.3), "0.jpg")
    up = np.array([0.0, 0.0, 1.0])
    scene = TrainedScene(
        surface_of_the_demo(view), [view], {}, (0.5, 0.5, 0.5), False, 0.03, up=up, **changes
    )
    write_report(report(trained=scene, comparisons=[]), tmp_path / "report.html")
    page.goto((tmp_path / "report.html").as_uri())
    page.evaluate("viewer.ready")
    return view


def place(page: Any, view: View, point: tuple[float, float, float]) -> tuple[float, float]:
    """Where a point of the world is on the screen."""
    area = page.locator("#space canvas").bounding_box()
    x, y, z = view.world_to_camera[:3] @ [*point, 1]
    focal = area["height"] / 2 / np.tan(np.radians(state(page)["fov"]) / 2)
    middle = area["x"] + area["width"] / 2, area["y"] + area["height"] / 2
    return middle[0] + focal * x / z, middle[1] + focal * y / z


@pytest.mark.parametrize(
    ("start", "end"), [(FLOOR, CAP), (FLOOR, BOX), (COLUMN, FLOOR), (CAP, BOX)]
)
def test_known_sizes_are_measured_to_one_percent(
    page: Any,
    tmp_path: Path,
    start: tuple[float, float, float],
    end: tuple[float, float, float],
) -> None:
    """Between clicks on the surface, in the unit of the exported Gaussians; Escape clears."""
    view = load_demo(page, tmp_path, is_metric=True, normalization=Normalization(0.5))
    page.get_by_role("button", name="Measure").click()
    for point in (start, end):
        page.mouse.click(*place(page, view, point))
    found = state(page)["lengths"]
    x, y, z = 2 * np.subtract(end, start)
    assert found["distance"] == pytest.approx(np.sqrt(x**2 + y**2 + z**2), rel=0.01)
    assert found["height"] == pytest.approx(z, rel=0.01)
    assert found["horizontal"] == pytest.approx(np.hypot(x, y), rel=0.01)
    said = page.locator("#space .measured").inner_text()
    assert said.startswith(f"{found['distance']:.4g} m")
    page.keyboard.press("Escape")
    assert state(page)["lengths"] is None and not page.locator("#space .measured").is_visible()


def test_the_keyboard_measures_from_the_middle_of_the_view(page: Any, tmp_path: Path) -> None:
    """The second point is the same as the first until the view turns."""
    load_demo(page, tmp_path)
    button = page.get_by_role("button", name="Measure")
    button.focus()
    page.keyboard.press("Enter")
    assert button.get_attribute("aria-pressed") == "true"
    said = page.locator("#space .measured")
    assert "First point" in said.inner_text()
    page.keyboard.press("Enter")
    assert "Second point" in said.inner_text()
    page.keyboard.press("Shift+ArrowLeft")
    page.keyboard.press("Enter")
    assert state(page)["lengths"]["distance"] > 0
    assert "scene units" in said.inner_text()
    button.click()
    assert state(page)["lengths"] is None and button.get_attribute("aria-pressed") == "false"
