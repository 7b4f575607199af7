"""Bundler, OpenSfM, OpenMVG and Pix4D: axes, lens models, images without a pose, hostile files."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.geometry.cameras import Camera
from pipeline.io.poses import bundler, openmvg, opensfm, pix4d, pix4d_angles
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import Reconstruction
from tests.io.poses.known import (
    FLIP_YZ,
    HEIGHT,
    UTM,
    WIDTH,
    check_same,
    known_scene,
    opencv,
    read,
)

CURVED = opencv(-0.1, 0.03, 1e-3, -2e-3)
K3 = opencv(-0.1, 0.03, 1e-3, -2e-3, 0.01, 0, 0, 0)


def square(model: str, *rest: float) -> Camera:
    """A camera with one focal length and its principal point off the centre."""
    return Camera(model, WIDTH, HEIGHT, np.array([500.0, 500.0, 322.5, 237.25, *rest]))


# --- Bundler ------------------------------------------------------------------------------


def bundle(known: Reconstruction, k1: float = 0.0, k2: float = 0.0) -> str:
    lines = ["# Bundle file v0.3", f"{len(known.images) + 1} 1"]
    for image in known.images.values():
        rotation, translation = FLIP_YZ @ image.rotation, FLIP_YZ @ image.translation
        lines.append(f"500.0 {k1} {k2}")
        lines += [" ".join(map(repr, row.tolist())) for row in (*rotation, translation)]
    lines += ["0 0 0"] * 5
    return "\n".join([*lines, "1.0 2.0 3.0", "255 0 0", "1 0 5 10.5 -3.25"]) + "\n"


def write_bundle(folder: Path, content: str | bytes, names: list[str], where: str = ".") -> Path:
    (folder / "list.txt").write_text("".join(f"{name} 0 700.5\n" for name in [*names, "no.jpg"]))
    file = folder / where / "bundle.out"
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    return file


@pytest.mark.parametrize("where", [".", "bundle"])
def test_bundler(tmp_path, where):
    lens = Camera("RADIAL", WIDTH, HEIGHT, np.array([500.0, WIDTH / 2, HEIGHT / 2, -0.1, 0.03]))
    known = known_scene(lens, names="my photo {}.jpg")
    write_bundle(tmp_path, bundle(known, -0.1, 0.03), sorted(known.by_name()), where)
    check_same(read("bundler", tmp_path), known)


def test_a_list_of_another_length_is_an_error(tmp_path):
    file = write_bundle(tmp_path, bundle(known_scene(opencv())), ["a.jpg"])
    with pytest.raises(UserError, match="found 2 and 5"):
        bundler.frames(file)


# --- OpenSfM ------------------------------------------------------------------------------


def opensfm_json(known: Reconstruction, camera: dict) -> str:
    shots = {}
    for image in known.images.values():
        vector = cv2.Rodrigues(image.rotation)[0].ravel()
        pose = {"rotation": vector.tolist(), "translation": image.translation.tolist()}
        shots[image.name] = {**pose, "camera": "v2 unknown", "orientation": 1, "gps_dop": 15.0}
    whole = {"cameras": {"v2 unknown": camera}, "shots": shots, "points": {}}
    small = {"cameras": {}, "shots": {}, "points": {}}
    return json.dumps([small, whole])


def opensfm_camera(lens: Camera, kind: str, *names: str) -> dict:
    fx, fy, cx, cy, *rest = lens.params.tolist()
    return {
        "projection_type": kind,
        "width": WIDTH,
        "height": HEIGHT,
        "focal_x": fx / WIDTH,
        "focal_y": fy / WIDTH,
        "c_x": (cx - WIDTH / 2) / WIDTH,
        "c_y": (cy - HEIGHT / 2) / WIDTH,
        **dict(zip(names, rest, strict=False)),
    }


FISHEYE = Camera(
    "OPENCV_FISHEYE", WIDTH, HEIGHT, np.array([300.0, 301, 322, 237, 0.05, -0.01, 0.002, 1e-4])
)
WIDE = Camera(
    "RAD_TAN_THIN_PRISM_FISHEYE",
    WIDTH,
    HEIGHT,
    np.array([300.0, 301, 322, 237, 0.05, -0.01, 2e-3, 1e-4, 1e-5, 1e-6, 1e-3, -2e-3, 0, 0, 0, 0]),
)
SIX = ("k1", "k2", "k3", "k4", "k5", "k6", "p2", "p1")


@pytest.mark.parametrize(
    ("lens", "kind", "names"),
    [
        (K3, "brown", ("k1", "k2", "p1", "p2", "k3")),
        (FISHEYE, "fisheye_opencv", ("k1", "k2", "k3", "k4")),
        (WIDE, "fisheye62", SIX),
    ],
)
def test_opensfm(tmp_path, lens, kind, names):
    known = known_scene(lens)
    content = opensfm_json(known, opensfm_camera(lens, kind, *names))
    (tmp_path / "reconstruction.json").write_text(content)
    check_same(read("opensfm", tmp_path), known)


def test_opensfm_perspective(tmp_path):
    lens = Camera("RADIAL", WIDTH, HEIGHT, np.array([500.0, WIDTH / 2, HEIGHT / 2, -0.1, 0.03]))
    camera = {"projection_type": "perspective", "width": WIDTH, "height": HEIGHT}
    camera |= {"focal": 500 / WIDTH, "k1": -0.1, "k2": 0.03}
    known = known_scene(lens, origin=UTM / 100)
    (tmp_path / "reconstruction.json").write_text(opensfm_json(known, camera))
    check_same(read("opensfm", tmp_path), known)


@pytest.mark.parametrize("kind", ["spherical", "equirectangular", "dual"])
def test_opensfm_panoramas_are_an_error_that_names_them(tmp_path, kind):
    file = tmp_path / "reconstruction.json"
    camera = {"projection_type": kind, "width": WIDTH, "height": HEIGHT}
    file.write_text(opensfm_json(known_scene(opencv()), camera))
    with pytest.raises(UserError, match=f"{kind} cameras are not supported"):
        opensfm.frames(file)


# --- OpenMVG ------------------------------------------------------------------------------


def openmvg_json(known: Reconstruction, nested: bool = False, **disto: list[float]) -> str:
    def pointer(**data) -> dict:
        return {"polymorphic_id": 1, "ptr_wrapper": {"id": 2147483649, "data": data}}

    views, poses = [], []
    for i, image in enumerate([*known.images.values(), None]):
        name = image.name if image is not None else "without_pose.jpg"
        data = {"local_path": "", "filename": name, "width": WIDTH, "height": HEIGHT}
        ids = {"id_view": i, "id_intrinsic": 0, "id_pose": i}
        views.append({"key": i, "value": pointer(**data, **ids)})
        if image is not None:
            pose = {"rotation": image.rotation.tolist(), "center": image.centre.tolist()}
            poses.append({"key": i, "value": pose})
    pinhole = {"width": WIDTH, "height": HEIGHT, "focal_length": 500.0}
    pinhole |= {"principal_point": [322.5, 237.25]}
    fields = {"value0": pinhole} if nested else pinhole
    content = {"sfm_data_version": "0.3", "root_path": "/home/u/images", "views": views}
    content["intrinsics"] = [{"key": 0, "value": pointer(**fields, **disto)}]
    return json.dumps({**content, "extrinsics": poses, "structure": [], "control_points": []})


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize(
    ("lens", "disto"),
    [
        (square("PINHOLE"), {}),
        (square("OPENCV", -0.1, 0, 0, 0), {"disto_k1": [-0.1]}),
        (square("FULL_OPENCV", -0.1, 0.03, 0, 0, 0.01, 0, 0, 0), {"disto_k3": [-0.1, 0.03, 0.01]}),
        (
            square("FULL_OPENCV", -0.1, 0.03, 1e-3, -2e-3, 0.01, 0, 0, 0),
            {"disto_t2": [-0.1, 0.03, 0.01, 1e-3, -2e-3]},
        ),
        (
            square("OPENCV_FISHEYE", 0.05, -0.01, 2e-3, 1e-4),
            {"fisheye": [0.05, -0.01, 2e-3, 1e-4]},
        ),
    ],
)
def test_openmvg(tmp_path, lens, disto, nested):
    known = known_scene(lens, origin=UTM)
    (tmp_path / "sfm_data.json").write_text(openmvg_json(known, nested, **disto))
    check_same(read("openmvg", tmp_path), known)


def test_openmvg_spherical_cameras_are_an_error(tmp_path):
    file = tmp_path / "sfm_data.json"
    content = openmvg_json(known_scene(opencv())).replace("focal_length", "other")
    file.write_text(content)
    with pytest.raises(UserError, match="spherical cameras are not supported"):
        openmvg.frames(file)


# --- Pix4D --------------------------------------------------------------------------------


def pix4d_text(known: Reconstruction, offset: np.ndarray) -> str:
    lines = ["fileName imageWidth imageHeight ", "camera matrix K [3x3]"]
    lines += ["radial distortion [3x1]", "tangential distortion [2x1]"]
    lines += ["camera position t [3x1]", "camera rotation R [3x3]"]
    lines += ["camera model m = K [R|-Rt] X", ""]
    for image in known.images.values():
        fx, fy, cx, cy, k1, k2, p1, p2, k3, *_ = known.cameras[1].params.tolist()
        rows = [[fx, 0, cx], [0, fy, cy], [0, 0, 1], [k1, k2, k3], [p1, p2]]
        rows += [(image.centre - offset).tolist(), *image.rotation.tolist()]
        lines.append(f"{image.name} {WIDTH} {HEIGHT}")
        lines += [" ".join(map(repr, row)) for row in rows]
    return "\n".join(lines) + "\n"


def write_pix4d(folder: Path, content: str | bytes) -> Path:
    file = folder / "site_calibrated_camera_parameters.txt"
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    return file


def test_pix4d(tmp_path):
    offset = np.round(UTM)
    known = known_scene(K3, origin=UTM)
    write_pix4d(tmp_path, pix4d_text(known, offset))
    (tmp_path / "site_offset.xyz").write_text(" ".join(map(str, offset)))
    check_same(read("pix4d", tmp_path), known)


@pytest.mark.parametrize("text", ["", "a.jpg 1", "nan nan nan", "1 2"])
def test_pix4d_messages(tmp_path, text):
    file = write_pix4d(tmp_path, pix4d_text(known_scene(K3), np.zeros(3)))
    (tmp_path / "site_offset.xyz").write_text(text)
    with pytest.raises(UserError, match="expected"):
        pix4d.frames(file)


def angles_text(known: Reconstruction) -> str:
    lines = ["imageName X Y Z Omega Phi Kappa"]
    for image in known.images.values():
        r = image.rotation.T @ FLIP_YZ  # = Rx Ry Rz
        angles = np.arctan2(-r[1, 2], r[2, 2]), np.arcsin(r[0, 2]), np.arctan2(-r[0, 1], r[0, 0])
        values = [*image.centre.tolist(), *np.degrees(angles).tolist()]
        lines.append(" ".join([image.name, *map(repr, values)]))
    return "\n".join(lines) + "\n"


def cam_text(lens: Camera) -> str:
    mm = 12.8 / WIDTH
    f, _, cx, cy, k1, k2, t1, t2, k3, *_ = lens.params.tolist()
    return f"""Pix4D camera calibration file 0
#Focal Length mm assuming a sensor width of 12.8x9.6mm
F {f * mm!r}
#Principal Point mm
Px {cx * mm!r}
Py {cy * mm!r}
#Symmetrical Lens Distortion Coeffs
K1 {k1}
K2 {k2}
K3 {k3}
#Tangential Lens Distortion Coeffs
T1 {t1}
T2 {t2}
"""


def write_angles(folder: Path, poses: str | bytes, camera: str) -> Path:
    (folder / "a_pix4d_calibrated_internal_camera_parameters.cam").write_text(camera)
    file = folder / "a_calibrated_external_camera_parameters.txt"
    file.write_bytes(poses.encode() if isinstance(poses, str) else poses)
    return file


def test_pix4d_angles(tmp_path):
    lens = square("FULL_OPENCV", -0.1, 0.03, 1e-3, -2e-3, 0.01, 0, 0, 0)
    known = known_scene(lens, origin=UTM, names="my photo {}.jpg")
    write_angles(tmp_path, angles_text(known), cam_text(lens))
    check_same(read("pix4d_angles", tmp_path), known)


def test_several_cameras_of_pix4d_are_an_error(tmp_path):
    file = write_angles(tmp_path, angles_text(known_scene(K3)), 2 * cam_text(K3))
    with pytest.raises(UserError, match=r"expected one camera.*found 2"):
        pix4d_angles.frames(file)
