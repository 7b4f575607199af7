"""Models are aligned by ground control points, GPS or the orientation of the cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from pipeline.runtime.errors import UserError
from pipeline.runtime.isolate import run_isolated
from pipeline.scene.manifest import Manifest, Photo
from tests.sfm import corner
from tests.sfm.test_georeference import ORIGIN, geodetic

COUNT = 8
# From the frame of ``corner`` (y down) to metres east, north, up, forty times as large.
TO_ENU = 40.0 * np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
CENTRES = np.array([-rotation.T @ shift for rotation, shift in corner.poses(COUNT)])
TRUE = CENTRES @ TO_ENU.T


def photos(with_gps: bool) -> Manifest:
    size = {"width": corner.WIDTH, "height": corner.HEIGHT}
    found = [
        Photo(name=f"{i}.jpg", path="", digest="", gps=tuple(place) if with_gps else None, **size)
        for i, place in enumerate(geodetic(TRUE).tolist())
    ]
    return Manifest(scene="corner", photos=tuple(found))


def aligned(manifest: Manifest, method: str, control: Path | None) -> tuple[str, np.ndarray, list]:
    """Method, camera centres in the world frame, and warnings."""
    import pycolmap

    from pipeline.sfm.alignment import align_model
    from pipeline.sfm.models import posed_model

    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_RADIAL", corner.FOCAL, corner.WIDTH, corner.HEIGHT
    )
    poses = [
        pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), shift)
        for rotation, shift in corner.poses(COUNT)
    ]
    model = posed_model([camera], [(i + 1, f"{i}.jpg", 1) for i in range(COUNT)], poses)
    frame = align_model(model, manifest, method, control)  # type: ignore[arg-type]
    centres = np.array([model.image(i + 1).projection_center() for i in range(COUNT)])
    return frame.method, centres, frame.warnings


def centred(centres: np.ndarray) -> np.ndarray:
    return np.asarray(centres - centres.mean(0))


def test_gps_aligns_a_model_to_metres():
    method, centres, warnings = run_isolated(aligned, photos(True), "gps", None)
    assert method == "gps" and not warnings
    np.testing.assert_allclose(centred(centres), centred(TRUE), atol=0.05)


def test_ground_control_points_are_triangulated_and_preferred_to_gps(tmp_path):
    rng = np.random.default_rng(0)
    lines = ["WGS84 UTM 32N"]
    place = Transformer.from_crs(4326, 32632, always_xy=True).transform(ORIGIN[1], ORIGIN[0])
    for xyz in rng.uniform(0.1, 0.8, (6, 3)) * (1, -1, -1):
        east, north, up = TO_ENU @ xyz + (*place, 400)
        for i in (1, 4, 6):
            rotation, shift = corner.poses(COUNT)[i]
            x, y, z = rotation @ xyz + shift
            px = corner.FOCAL * x / z + corner.WIDTH / 2 - 0.5
            py = corner.FOCAL * y / z + corner.HEIGHT / 2 - 0.5
            lines.append(f"{east} {north} {up} {px} {py} {i}.jpg")
    control = tmp_path / "gcp_list.txt"
    control.write_text("\n".join(lines))
    method, centres, warnings = run_isolated(aligned, photos(True), "gcp", control)
    assert method == "gcp" and not warnings
    np.testing.assert_allclose(centred(centres), centred(TRUE), atol=1e-3)
    assert np.abs(centres).max() < 200


def test_without_gps_and_ground_control_the_frame_is_level():
    method, centres, warnings = run_isolated(aligned, photos(False), "none", None)
    assert method == "level" and not warnings
    assert np.linalg.norm(centres, axis=1).max() == pytest.approx(1.0)
    # y points down.
    assert np.corrcoef(centres[:, 1], CENTRES[:, 1])[0, 1] > 0.97
    assert run_isolated(aligned, photos(True), "none", None)[0] == "level"


def test_a_method_without_its_data_warns_or_raises():
    method, _, warnings = run_isolated(aligned, photos(False), "gps", None)
    assert method == "level" and "only 0 photographs" in warnings[0]
    with pytest.raises(UserError, match="no ground control points"):
        run_isolated(aligned, photos(False), "gcp", None)
