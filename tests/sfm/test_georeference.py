"""World frames from GPS, ground control points and camera orientations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry.geodesy import to_ecef, to_enu
from pipeline.geometry.similarity import Similarity
from pipeline.io.gcp import GroundControl, read_ground_control
from pipeline.runtime.errors import UserError
from pipeline.scene.georeference import CartesianOrigin, GeographicOrigin, Georeference
from pipeline.sfm.gcp_frame import Triangulated, from_gcp
from pipeline.sfm.georeference import Cameras, WorldFrame, level
from pipeline.sfm.gps_frame import from_gps

ORIGIN = np.array([47.37, 8.54, 410.0])
METRES_PER_DEGREE = 111_194.0


def rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def geodetic(enu: np.ndarray) -> np.ndarray:
    """Inverse of ``to_enu`` around ORIGIN, by Newton's method."""
    found = np.tile(ORIGIN, (len(enu), 1))
    scale = [1 / METRES_PER_DEGREE, 1 / METRES_PER_DEGREE / np.cos(np.radians(ORIGIN[0])), 1.0]
    for _ in range(20):
        error = enu - to_enu(found, ORIGIN)
        found += error[:, [1, 0, 2]] * scale
    return found


def scene(enu: np.ndarray, seed: int = 3) -> tuple[Cameras, Similarity]:
    """Cameras in an arbitrary frame, and the similarity from there to metres."""
    turn, size, shift = rotation(seed), 0.037, np.array([3.0, -2.0, 9.0])
    centres = size * enu @ turn.T + shift
    names = [f"{i}.jpg" for i in range(len(enu))]
    back = Similarity(1 / size, turn.T, -turn.T @ shift / size)
    return Cameras(names, centres, turn @ [0.0, 0.0, 1.0]), back


def positions(cameras: Cameras, enu: np.ndarray) -> dict:
    return {n: tuple(p) for n, p in zip(cameras.names, geodetic(enu).tolist(), strict=True)}


def survey(seed: int = 0, count: int = 40) -> np.ndarray:
    """(count, 3) positions of a flight over 80 m by 60 m at a height of 50 m, metres."""
    rng = np.random.default_rng(seed)
    return rng.uniform((-40, -30, 48), (40, 30, 52), (count, 3))


def test_ecef_of_known_positions():
    # On the equator at longitude 0, and at the pole: the semi-axes of the ellipsoid.
    np.testing.assert_allclose(to_ecef(np.array([0.0, 0.0, 0.0])), [6378137.0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(
        to_ecef(np.array([90.0, 0.0, 0.0])), [0, 0, 6356752.314245], atol=1e-5
    )


def test_enu_axes():
    places = np.array([[47.37, 8.541, 410.0], [47.371, 8.54, 410.0], [47.37, 8.54, 420.0]])
    east, north, up = to_enu(places, ORIGIN)
    assert east[0] == pytest.approx(75.5, rel=0.01) and abs(east[1]) < 0.01
    assert north[1] == pytest.approx(111.2, rel=0.01) and abs(north[0]) < 0.01
    np.testing.assert_allclose(up, [0, 0, 10], atol=1e-6)


@settings(max_examples=5, derandomize=True, deadline=None)
@given(st.integers(0, 10_000))
def test_exact_gps_gives_the_exact_frame(seed):
    enu = survey(seed)
    cameras, _ = scene(enu, seed)
    frame = from_gps(cameras, positions(cameras, enu))
    assert isinstance(frame, WorldFrame) and frame.method == "gps"
    found = frame.similarity(cameras.centres)
    # The origin of the frame is the median position.
    np.testing.assert_allclose(found - found.mean(0), enu - enu.mean(0), atol=0.02)
    assert isinstance(frame.origin, GeographicOrigin)


def test_gps_with_noisy_altitudes_and_outliers():
    """Noisy altitudes and a fifth of outliers: rotation and scale are still accurate, and the
    outliers are listed."""
    rng, true = np.random.default_rng(1), survey(count=60)
    measured = true + rng.normal(0, (2.0, 2.0, 8.0), true.shape)
    measured[::5, :2] += rng.uniform(200, 400, (12, 2))
    cameras, back = scene(true)
    frame = from_gps(cameras, positions(cameras, measured))
    assert isinstance(frame, WorldFrame)
    assert frame.similarity.scale == pytest.approx(back.scale, rel=0.05)
    turn = frame.similarity.rotation @ back.rotation.T
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 8
    left_out = {row.name for row in frame.residuals if not row.used}
    assert left_out >= {f"{i}.jpg" for i in range(0, 60, 5)}
    assert any("outliers" in text for text in frame.warnings)


def test_gps_on_a_line_uses_the_up_direction_of_the_cameras():
    along = np.linspace(0, 60, 25)
    true = np.column_stack([along * 0.6, along * 0.8, np.full(25, 1.6)])
    rng = np.random.default_rng(2)
    measured = true + rng.normal(0, (1.0, 1.0, 3.0), true.shape)
    cameras, back = scene(true)
    frame = from_gps(cameras, positions(cameras, measured))
    assert isinstance(frame, WorldFrame)
    assert any("lie on a line" in text for text in frame.warnings)
    assert frame.similarity.scale == pytest.approx(back.scale, rel=0.1)
    up = frame.similarity.rotation @ cameras.up
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-6)
    heading = frame.similarity(cameras.centres)
    heading = heading[-1] - heading[0]
    np.testing.assert_allclose(heading[:2] / np.linalg.norm(heading), [0.6, 0.8], atol=0.1)


@pytest.mark.parametrize(
    ("size", "noise", "why"),
    [(1.0, 4.0, "spread over"), (0.0, 0.0, "line along|spread over|positions lie")],
)
def test_gps_that_is_too_inaccurate_is_rejected(size, noise, why):
    """The path is smaller than the error of GPS, or all positions are equal."""
    rng = np.random.default_rng(4)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) * 2.0
    cameras, _ = scene(ring)
    measured = size * ring + rng.normal(0, 1, ring.shape) * noise
    assert isinstance(reason := from_gps(cameras, positions(cameras, measured)), str)
    assert any(part in reason for part in why.split("|")), reason
    assert isinstance(from_gps(cameras, {}), str)


def test_positions_on_both_sides_of_the_date_line():
    cameras, _ = scene(survey())
    lonlat = geodetic(survey())
    lonlat[:, 1] += 180.0 - ORIGIN[1]
    lonlat[:, 1] = (lonlat[:, 1] + 180) % 360 - 180
    assert np.ptp(lonlat[:, 1]) > 300
    given_ = {n: tuple(p) for n, p in zip(cameras.names, lonlat.tolist(), strict=True)}
    frame = from_gps(cameras, given_)
    assert isinstance(frame, WorldFrame) and max(r.horizontal_m for r in frame.residuals) < 0.1


def test_the_level_frame_has_unit_scale():
    true = survey()
    cameras, _ = scene(true)
    frame = level(cameras)
    centres = frame.similarity(cameras.centres)
    np.testing.assert_allclose(centres.mean(0), 0, atol=1e-9)
    distances = np.sort(np.linalg.norm(centres, axis=1))
    assert distances[int(0.95 * len(distances))] == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(frame.similarity.rotation @ cameras.up, [0, -1, 0], atol=1e-9)
    # A single camera has no extent, and needs a rotation by 180 degrees.
    alone = Cameras(["a"], np.array([[1.0, 2, 3]]), np.array([0.0, 1.0, 0.0]))
    moved = level(alone).similarity
    np.testing.assert_allclose(moved.rotation @ alone.up, [0, -1, 0], atol=1e-9)
    assert np.linalg.det(moved.rotation) == pytest.approx(1) and moved.scale == 1


GCP = """WGS84 UTM 32N
# x y z px py image name
465000.5 5246000.25 410.5 100.5 200 a.jpg one
465000.5 5246000.25 410.5 300 200 sub/b.jpg one

465020 5246010 412 5 6 A.jpg two
465020 5246010 412 7 8 b.jpg two
465000 5246030 409 1 2 missing.jpg three
"""


def test_ground_control_file(tmp_path):
    path = tmp_path / "gcp_list.txt"
    path.write_text(GCP)
    control = read_ground_control(path, {"a.jpg": (640, 480), "sub/b.jpg": (640, 480)})
    assert control.projection.text == "WGS84 UTM 32N" and not control.geographic
    assert [p.name for p in control.points] == ["one", "two"] and control.unknown == (
        "missing.jpg",
    )
    # Whole numbers are OpenDroneMap's pixel centres.
    assert control.points[0].pixels == {"a.jpg": (101.0, 200.5), "sub/b.jpg": (300.5, 200.5)}
    assert set(control.points[1].pixels) == {"a.jpg", "sub/b.jpg"}


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "expected a projection"),
        ("1 2 3 4 5 a.jpg\n", "expected a projection"),
        ("EPSG:32632\n1 2 3 4 a.jpg\n", "line 2 is malformed"),
        ("EPSG:32632\n1 2 nan 4 5 a.jpg\n", "line 2 is not finite"),
        ("EPSG:32632\n\n1 2 3 4 5\n", "line 3 is malformed"),
    ],
)
def test_malformed_ground_control_is_an_error(tmp_path, text, what):
    path = tmp_path / "gcp_list.txt"
    path.write_text(text)
    with pytest.raises(UserError, match=what) as error:
        read_ground_control(path, {"a.jpg": (640, 480)})
    assert error.value.fix


def control_of(places: np.ndarray, tmp_path) -> GroundControl:
    lines = ["EPSG:32632"]
    lines += [f"{x!r} {y!r} {z!r} {i} 0 a.jpg p{i}" for i, (x, y, z) in enumerate(places.tolist())]
    path = tmp_path / "gcp_list.txt"
    path.write_text("\n".join(lines))
    return read_ground_control(path, {"a.jpg": (640, 480)})


def seen_at(places: np.ndarray):
    """Triangulation of points whose column in a.jpg is their number."""
    return lambda seen: Triangulated(places[round(seen["a.jpg"][0] - 0.5)], 1e-4)


def test_ground_control_gives_projected_metres_around_a_local_origin(tmp_path):
    """UTM coordinates are too large for float32: an origin is subtracted. Outliers are left out."""
    rng = np.random.default_rng(5)
    places = rng.uniform((465000, 5246000, 400), (465080, 5246060, 415), (9, 3))
    cameras, back = scene(places)
    ours = (places - back.translation) @ back.rotation / back.scale
    given_ = places + rng.normal(0, 0.01, places.shape)
    given_[4] += (0, 6.0, 0)
    control = control_of(given_, tmp_path)

    frame = from_gcp(control, seen_at(ours), cameras)
    assert isinstance(frame, WorldFrame) and frame.projection.text == "EPSG:32632"
    assert isinstance(frame.origin, CartesianOrigin)
    origin = np.array([frame.origin.x, frame.origin.y, frame.origin.z])
    moved = frame.similarity(ours)
    assert np.abs(moved).max() < 100
    np.testing.assert_allclose(moved + origin, places, atol=0.03)
    assert [row.name for row in frame.residuals if not row.used] == ["p4"]
    frame.georeference().write(tmp_path)
    found = Georeference.read(tmp_path)
    assert found == frame.georeference() and found.is_metric
    assert found.residuals_m is not None and found.residuals_m.left_out == 1


def test_ground_control_on_a_line_or_unobserved_is_rejected(tmp_path):
    line = np.linspace(0, 1, 6)[:, None] * [30.0, 40.0, 1.0]
    control, (cameras, _) = control_of(line, tmp_path), scene(line)
    reason = from_gcp(control, seen_at(line), cameras)
    assert isinstance(reason, str) and "line" in reason
    assert "only 0 of 6" in str(from_gcp(control, lambda seen: None, cameras))


def test_altitudes_on_one_strip_do_not_determine_the_tilt():
    """The horizontal positions of the other strip change with the tilt by its cosine only: they
    are no measurement of it, and a fit that is tilted by mistake must not look certain."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        across = np.where(np.arange(24) % 2, -35.0, 35.0)
        true = np.column_stack([np.linspace(-50, 50, 24), across, 55 + 5 * rng.random(24)])
        measured = true + rng.normal(0, (1.5, 1.5, 4.0), true.shape)
        cameras, back = scene(true, seed)
        known = positions(cameras, measured)
        for name in cameras.names[1::2]:
            known[name] = (*known[name][:2], None)
        frame = from_gps(cameras, known)
        assert isinstance(frame, WorldFrame) and frame.fit is not None
        turn = frame.similarity.rotation @ back.rotation.T
        angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
        sigma = np.hypot(frame.fit.uncertainty.tilt, frame.fit.uncertainty.heading)
        assert angle < 3 * sigma, (seed, np.degrees(angle), np.degrees(sigma))
