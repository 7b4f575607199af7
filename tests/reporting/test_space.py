"""Input of the page's viewer: frame, cameras, points and reduced Gaussians."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.io.spz import decode_spz, encode_spz
from pipeline.reporting.depths import DEPTH_RATIO, coarse_depths, depth_codes
from pipeline.reporting.fit import Packed, fit, prominence
from pipeline.reporting.page import report_html
from pipeline.reporting.pictures import upright
from pipeline.reporting.space import (
    sized_for_spz,
    upright_camera,
    viewer_content,
    viewer_data,
    viewer_script,
)
from pipeline.scene.georeference import Georeference
from pipeline.scene.views import View
from pipeline.splats.arrays import GaussianArrays, GaussianRows, collect
from pipeline.splats.axes import RUB, Flipped
from pipeline.splats.levels import weights_of
from tests.reporting.made import gaussians, report, ring, sparse, trained

VIEWER = Path(__file__).parents[2] / "pipeline" / "reporting" / "viewer"


def tilted(views: list[View], tilt: np.ndarray) -> list[View]:
    """The same cameras in a world turned by ``tilt`` (3, 3)."""
    turn = np.eye(4)
    turn[:3, :3] = tilt.T
    return [dataclasses.replace(v, world_to_camera=v.world_to_camera @ turn) for v in views]


def rotation(seed: int) -> np.ndarray:
    tilt = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return tilt * np.sign(np.linalg.det(tilt))


def test_the_frame_is_upright_robust_and_keeps_shapes() -> None:
    """Upright cameras around the origin in a tilted world; one stray point."""
    rng, tilt = np.random.default_rng(0), rotation(0)
    points = np.concatenate([rng.normal(0, 0.5, (200, 3)) @ tilt.T, [[1e6, 0, 0]]])
    scene = trained(views=tilted(ring(12), tilt))
    made = viewer_data(report(trained=scene, points=sparse(points)))
    frame = np.array(made["frame"]).reshape(4, 4).T
    scale = np.cbrt(np.linalg.det(frame[:3, :3]))
    np.testing.assert_allclose(frame[:3, :3] @ frame[:3, :3].T, scale**2 * np.eye(3), atol=1e-9)
    np.testing.assert_allclose(frame[:3, :3] @ tilt @ [0, 0, 1], [0, scale, 0], atol=1e-9)
    for view, camera in zip(scene.views, made["cameras"], strict=True):
        np.testing.assert_allclose(camera["world_to_camera"], view.world_to_camera[:3].ravel())
        placed = frame @ [*view.centre, 1]
        assert 0.5 < np.abs(placed[:3]).max() < 1.5
    packed = np.frombuffer(base64.b64decode(made["points"]), "<i2").reshape(-1, 3)
    assert len(packed) == 200  # the stray one is left out
    placed = points[:200] @ frame[:3, :3].T + frame[:3, 3]
    np.testing.assert_allclose(packed * made["step"], placed, atol=made["step"])


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_a_scene_of_any_unit_keeps_its_digits(unit: float) -> None:
    """SPZ quantises positions and scales in a fixed unit; renders must not depend on the unit."""
    rng = np.random.default_rng(0)
    whole = gaussians()
    large = dataclasses.replace(
        whole,
        means=np.float32(whole.means * unit),
        log_scales=np.float32(whole.log_scales + np.log(unit)),
    )
    views = []
    for view in ring():
        pose = view.world_to_camera.copy()
        pose[:3, 3] *= unit
        views.append(dataclasses.replace(view, world_to_camera=pose))
    points = rng.normal(size=(300, 3)) * 0.5
    scene = trained(gaussians=large, views=views, near=0.03 * unit)
    made = sized_for_spz(report(trained=scene, points=sparse(points * unit)))
    scene = made.trained
    found = decode_spz(encode_spz(scene.gaussians))
    assert (found.log_scales > -9).all() and (found.log_scales < 4).all()
    scale = scene.near / 0.03
    assert 0.1 < scale < 10
    np.testing.assert_allclose(scene.gaussians.means, scale * whole.means, rtol=1e-4, atol=1e-6)
    for ours, view in zip(scene.views, ring(), strict=True):
        np.testing.assert_allclose(ours.centre, scale * view.centre, atol=1e-6)
    np.testing.assert_allclose(made.points.xyz, scale * points, rtol=1e-6)
    assert sized_for_spz(made) is made


@pytest.mark.parametrize(("method", "up"), [("gps", (0, 0, 1)), ("level", (0, -1, 0))])
def test_the_up_direction_of_a_georeference_is_the_pages(method: str, up: tuple[int, ...]) -> None:
    """Whatever direction the cameras have."""
    known = Georeference.model_construct(method=method).up
    scene = trained(views=tilted(ring(12), rotation(1)), up=known)
    frame = np.array(viewer_data(report(trained=scene))["frame"]).reshape(4, 4).T
    turned = frame[:3, :3] @ up
    np.testing.assert_allclose(turned / np.linalg.norm(turned), [0, 1, 0], atol=1e-9)
    assert Georeference.model_construct(method="given").up is None


def test_aerial_images_up_is_opposite_to_the_viewing_direction() -> None:
    """Cameras that look straight down, flown back and forth: their up directions cancel."""
    views = []
    for i, side in enumerate([1.0, -1.0] * 4):
        pose = np.eye(4)
        pose[:3, :3] = [[side, 0, 0], [0, -side, 0], [0, 0, -1]]
        pose[:3, 3] = -pose[:3, :3] @ [i, 0.0, 10.0]
        views.append(dataclasses.replace(ring()[0], world_to_camera=pose))
    scene = trained(views=views)
    frame = np.array(viewer_data(report(trained=scene))["frame"]).reshape(4, 4).T
    up = frame[:3, :3] @ [0, 0, 1]
    np.testing.assert_allclose(up / np.linalg.norm(up), [0, 1, 0], atol=1e-9)


def test_many_points_are_thinned() -> None:
    rng, many = np.random.default_rng(0), np.zeros((60_000, 3), np.uint8)
    made = viewer_data(report(points=sparse(rng.normal(size=many.shape), many)))
    assert len(base64.b64decode(made["points"])) == 25_000 * 6
    assert len(base64.b64decode(made["colours"])) == 25_000 * 3


@pytest.mark.parametrize("orientation", [0, 1, 3, 6, 8])
def test_cameras_are_rotated_with_their_photographs(orientation: int) -> None:
    """The rotated camera projects a point to its pixel in the rotated image."""
    view = ring(3, width=40, height=30)[1]
    picture = np.zeros((30, 40, 3), np.uint8)
    column, row = 31, 4
    picture[row, column] = 255
    point = 2.0 * np.array(
        [(column + 0.5 - view.cx) / view.fx, (row + 0.5 - view.cy) / view.fy, 1.0]
    )
    pose = view.world_to_camera
    world = pose[:3, :3].T @ (point - pose[:3, 3])
    camera = upright_camera(view, orientation)
    turned = upright(picture, orientation)
    assert (camera["height"], camera["width"]) == turned.shape[:2]
    matrix = np.array(camera["world_to_camera"]).reshape(3, 4)
    assert np.linalg.det(matrix[:, :3]) == pytest.approx(1)
    x, y, z = matrix @ [*world, 1]
    u, v = camera["fx"] * x / z + camera["cx"], camera["fy"] * y / z + camera["cy"]
    assert turned[int(v), int(u), 0] == 255


def test_the_start_is_the_view_of_median_quality() -> None:
    median = dataclasses.replace(report().comparisons[0], label="median", name="3.jpg")
    assert viewer_data(report(comparisons=[median]))["start"] == 3
    assert viewer_data(report())["start"] == 2
    assert viewer_data(report(trained=trained(views=[])))["start"] is None


MANY = gaussians(5000)
CENTRES = np.array([view.centre for view in ring()])


def decoded(packed: Packed) -> GaussianArrays:
    """The Gaussians as the viewer has them, which takes the coordinates of the file as they are."""
    return collect(Flipped(decode_spz(packed.spz), RUB))


def test_scenes_that_fit_are_complete() -> None:
    whole = gaussians(3000)
    packed = fit(whole, CENTRES, 1_000_000)
    read = decoded(packed)
    assert (packed.count, packed.sh_degree) == (3000, 3) == (len(read), read.sh_degree)
    assert np.abs(read.means - whole.means).max() < 1e-3


def size(degree: int) -> int:
    return len(encode_spz(GaussianRows(MANY, np.arange(len(MANY)), degree)))


def test_harmonics_are_dropped_first_then_the_least_prominent() -> None:
    rooms = [size(3) * 1.1, size(1) * 1.1, size(0) * 0.6, size(0) * 0.2]
    kept = [fit(MANY, CENTRES, int(room)) for room in rooms]
    assert [packed.sh_degree for packed in kept] == [3, 1, 0, 0]
    assert [packed.count for packed in kept[:2]] == [len(MANY)] * 2
    assert 0.5 < kept[2].count / len(MANY) < 0.6
    for packed, room in zip(kept, rooms, strict=True):
        assert len(packed.spz) <= 1.02 * room
    read = decoded(kept[3])
    assert len(read) == kept[3].count
    values = prominence(MANY, CENTRES)
    limit = np.sort(values)[-len(read)]
    assert np.abs(read.means - MANY.means[values >= limit]).max() < 1e-3


def test_a_page_of_many_begins_with_merged_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few Gaussians have no such beginning; the size limit includes it."""
    monkeypatch.setattr("pipeline.reporting.fit.FIRST_GAUSSIANS", 100)
    whole = gaussians(1000)
    packed = fit(whole, CENTRES, 1_000_000)
    assert packed.first is not None
    first = collect(Flipped(decode_spz(packed.first), RUB))
    assert (len(first), first.sh_degree) == (100, 0)
    assert (packed.count, packed.sh_degree) == (1000, 3)
    # Merging keeps opacity times area, except where it would make Gaussians more than opaque.
    assert 0.5 < weights_of(first).sum() / weights_of(whole).sum() < 1.1
    room = len(packed.spz) + len(packed.first) // 2
    less = fit(whole, CENTRES, room)
    assert less.first is not None
    assert len(less.spz) + len(less.first) <= 1.02 * room
    assert fit(gaussians(200), CENTRES, 1_000_000).first is None


def test_prominence_is_opacity_times_the_angle_seen() -> None:
    four = gaussians(4)
    four.means[:] = [[0, 0, 2], [0, 0, 2], [0, 0, 2], [0, 0, 4]]
    opacity = np.array([0.5, 0.25, 0.5, 0.5])
    four.opacity_logits[:] = np.log(opacity / (1 - opacity))
    four.log_scales[:] = np.log([0.1, 0.2, 0.3])
    four.log_scales[2] += np.log(2)
    values = prominence(four, np.zeros((1, 3)))
    np.testing.assert_allclose(values / values[0], [1, 0.5, 2, 0.5], rtol=1e-5)


def test_the_page_reports_what_was_dropped() -> None:
    data = report(trained=trained(gaussians=MANY))
    assert viewer_content(data, 10_000_000).shown == "5,000 Gaussians"
    small = viewer_content(data, size(0) * 3 // 2).shown
    assert "5,000 Gaussians (to limit its size, this page has SH of degree 0 instead of 3" in small
    smaller = viewer_content(data, size(0) // 2).shown
    assert "most prominent with SH of degree 0 instead of 3)" in smaller


def test_a_page_of_a_hundred_thousand_gaussians_stays_under_15_mb() -> None:
    html = report_html(report(trained=trained(gaussians=gaussians(100_000))))
    assert len(html.encode()) < 15_000_000
    assert "100,000 Gaussians</span>" in html


def test_the_viewer_is_built_from_its_sources_and_stays_inside_its_script() -> None:
    """``make viewer`` after a change; the notices of what it holds are kept."""
    script = viewer_script()
    files = [VIEWER / "package-lock.json", *sorted((VIEWER / "src").glob("*.js"))]
    sources = b"".join(file.read_bytes() for file in files)
    assert script.endswith(f"// sources: {hashlib.sha256(sources).hexdigest()}\n")
    assert "</script" not in script and "<!--" not in script
    for notice in ("MIT License", "World Labs Technologies", "three.js authors", "Arjun Barrett"):
        assert notice in script


def test_pages_are_written_without_torch() -> None:
    modules = "pipeline.reporting.scene, pipeline.reporting.page, pipeline.reporting.collect"
    code = f"import {modules}, sys; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_coarse_depths_are_those_of_the_nearest_opaque_surface() -> None:
    """A wall at 4 fills the image, behind it one at 8; a thin veil at 1; sky in the upper rows."""
    view = ring(1)[0]
    pose = np.eye(4)
    view = dataclasses.replace(view, world_to_camera=pose, cx=100.0, cy=75.0)
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-1, 1, 60)))
    below = y > 0.02
    walls = [np.column_stack([z * x, z * y, np.full(len(x), z)])[below] for z in (1.0, 4.0, 8.0)]
    made = gaussians(3 * below.sum(), degree=0)
    made.means[:] = np.concatenate(walls)
    made.log_scales[:] = np.log(0.03 * made.means[:, 2:])
    made.opacity_logits[:] = np.repeat([-5.0, 3.0, 3.0], below.sum())
    depths = coarse_depths(made, [upright_camera(view, 1)], 0.1)[0]
    np.testing.assert_allclose(depths[7:], 4, rtol=1e-6)
    assert np.isinf(depths[:5]).all()
    codes = depth_codes(depths, 0.1)
    assert not codes[:5].any()
    np.testing.assert_allclose(0.1 * DEPTH_RATIO ** (codes[7:] - 1.0), 4, rtol=0.03)


def test_the_poster_is_in_the_page_before_the_gaussians() -> None:
    views = [dataclasses.replace(v, name="1.jpg") for v in report().comparisons]
    html = report_html(report(comparisons=views))
    assert 0 < html.index('class="poster"') < html.index('id="splats"')
