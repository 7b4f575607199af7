"""Metashape's XML: axes, similarity, calibrations, cameras that are left out, hostile files."""

from __future__ import annotations

import re

import numpy as np
import pytest

from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import quat_to_rotation
from pipeline.io.poses import metashape
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import Reconstruction
from tests.io.poses.known import (
    HEIGHT,
    UTM,
    WIDTH,
    check_same,
    known_scene,
    opencv,
    read,
)

ROTATION = quat_to_rotation(np.array([0.4, -0.3, 0.8, 0.1]))
SCALE = 12.354192447331316


def calibration(camera: Camera, kind: str = "frame", **more: float) -> str:
    fx, fy, cx, cy, *rest = camera.params.tolist()
    names = ("k1", "k2", "k3", "k4") if kind == "fisheye" else ("k1", "k2", "p2", "p1", "k3")
    fields = {"f": fy, "cx": cx - WIDTH / 2, "cy": cy - HEIGHT / 2, "b1": fx - fy}
    fields |= dict(zip(names, rest, strict=False)) | more
    values = "".join(f"<{name}>{value!r}</{name}>" for name, value in fields.items())
    return (
        f'<calibration type="{kind}" class="initial"><resolution width="{WIDTH}" '
        f'height="{HEIGHT}"/><f>1</f></calibration><calibration type="{kind}" class="adjusted">'
        f'<resolution width="{WIDTH}" height="{HEIGHT}"/>{values}</calibration>'
    )


def text(values: np.ndarray) -> str:
    return " ".join(map(repr, values.ravel().tolist()))


def export(model: Reconstruction, lens: str, *, component: bool = True, extra: str = "") -> str:
    """The file that Metashape exports of a model whose chunk has another frame and scale."""
    translation = UTM - 3.0
    transform = (
        f'<transform><rotation locked="true">{text(ROTATION)}</rotation><translation '
        f'locked="true">{text(translation)}</translation><scale locked="true">{SCALE}</scale>'
        "</transform>"
    )
    cameras = ""
    for number, image in model.images.items():
        pose = np.eye(4)
        pose[:3, :3] = ROTATION.T @ image.rotation.T
        pose[:3, 3] = ROTATION.T @ (image.centre - translation) / SCALE
        owner = ' component_id="0"' if component else ""
        cameras += (
            f'<camera id="{number}" sensor_id="0"{owner} label="{image.name}"><transform>'
            f"{text(pose)}</transform><orientation>1</orientation></camera>\n"
        )
    parts = f'<component id="0" label="Component 1">{transform}</component>' if component else ""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n'
        '<chunk label="Chunk 1" enabled="true">\n<sensors next_id="1"><sensor id="0" '
        f'label="unknown" type="frame"><resolution width="{WIDTH}" height="{HEIGHT}"/>{lens}'
        f'</sensor></sensors>\n<components next_id="1" active_id="0">{parts}</components>\n'
        f'<cameras next_id="9" next_group_id="1"><group id="0" label="g" type="folder">\n{cameras}'
        f"</group>{extra}</cameras>\n{'' if component else transform}<reference>LOCAL_CS["
        '"Local"]</reference></chunk></document>\n'
    )


def write(folder, content: str | bytes):
    file = folder / "cameras.xml"
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    return file


CAMERAS = {
    "pinhole": opencv(),
    "opencv": opencv(-0.1, 0.03, 1e-3, -2e-3),
    "k3": opencv(-0.1, 0.03, 1e-3, -2e-3, 0.01, 0.0, 0.0, 0.0),
}


@pytest.mark.parametrize("component", [True, False])
@pytest.mark.parametrize("name", CAMERAS)
def test_known_cameras_are_read_back(tmp_path, name, component):
    known = known_scene(CAMERAS[name], origin=UTM)
    write(tmp_path, export(known, calibration(CAMERAS[name]), component=component))
    check_same(read("metashape", tmp_path), known)


def test_fisheye(tmp_path):
    camera = Camera(
        "OPENCV_FISHEYE", WIDTH, HEIGHT, np.array([300, 301, 322, 237, 0.05, -0.01, 0.002, 0])
    )
    known = known_scene(camera, origin=UTM)
    write(tmp_path, export(known, calibration(camera, "fisheye")))
    check_same(read("metashape", tmp_path), known)


def test_fisheye_with_tangential_distortion(tmp_path):
    params = np.array([300, 301, 322, 237, 0.05, -0.01, 1e-3, -2e-3, 0.002, 0, 0, 0])
    known = known_scene(Camera("THIN_PRISM_FISHEYE", WIDTH, HEIGHT, params), origin=UTM)
    plain = Camera("OPENCV_FISHEYE", WIDTH, HEIGHT, params[[0, 1, 2, 3, 4, 5, 8, 9]])
    write(tmp_path, export(known, calibration(plain, "fisheye", p2=1e-3, p1=-2e-3)))
    check_same(read("metashape", tmp_path), known)


def test_coefficients_without_a_counterpart_are_fitted_or_refused_with_the_residual(tmp_path):
    camera = opencv(-0.1, 0.03, 1e-3, -2e-3)
    known = known_scene(camera)
    file = write(tmp_path, export(known, calibration(camera, k4=1e-3, b2=0.01)))
    found = read("metashape", tmp_path)
    assert {entry.model for entry in found.cameras.values()} == {"FULL_OPENCV"}
    write(tmp_path, export(known, calibration(camera, b2=30.0)))
    with pytest.raises(UserError, match=r"sensor 0.*deviates by [\d.]+ px.*less than 0.05 px"):
        metashape.frames(file)


def test_disabled_and_unaligned_cameras_are_left_out(tmp_path):
    known = known_scene(opencv())
    extra = '<camera id="7" sensor_id="0" label="un.jpg"/><camera id="8" sensor_id="0" '
    extra += f'enabled="false" label="off.jpg"><transform>{text(np.eye(4))}</transform></camera>'
    write(tmp_path, export(known, calibration(opencv()), extra=extra))
    check_same(read("metashape", tmp_path), known)


def test_several_sensors(tmp_path):
    known = known_scene(opencv())
    content = export(known, calibration(opencv()))
    second = calibration(Camera("PINHOLE", WIDTH, HEIGHT, np.array([700.0, 700, 320, 240])))
    content = content.replace("</sensors>", f'<sensor id="1">{second}</sensor></sensors>')
    write(tmp_path, re.sub(r'sensor_id="0"(?=[^>]*p2.jpg)', 'sensor_id="1"', content))
    found = read("metashape", tmp_path)
    focal = {
        image.name: found.cameras[image.camera_id].pinhole[0] for image in found.images.values()
    }
    assert focal == {"p0.jpg": 500, "p1.jpg": 500, "p2.jpg": 700, "p3.jpg": 500}


def test_of_components_without_a_common_frame_the_largest_is_used(tmp_path):
    known = known_scene(opencv())
    content = export(known, calibration(opencv()), component=False)
    content = re.sub(
        r'label="p(\d)', lambda m: f'component_id="{int(m[1]) // 3}" label="p{m[1]}', content
    )
    write(tmp_path, content)
    assert sorted(read("metashape", tmp_path).by_name()) == ["p0.jpg", "p1.jpg", "p2.jpg"]


BOMB = """<?xml version="1.0"?><!DOCTYPE document [<!ENTITY a "xxxxxxxxxx">
<!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]><document><chunk label="&b;"/></document>"""
OUTSIDE = """<?xml version="1.0"?><!DOCTYPE document [<!ENTITY a SYSTEM "file:///etc/passwd">]>
<document><chunk><camera label="&a;"/></chunk></document>"""


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (BOMB, "without a document type"),
        (OUTSIDE, "without a document type"),
        ("<document><chunk/></document>", "aligned cameras"),
        ("<document/>", "cameras of Metashape"),
        ("<document>" + "<chunk>" * 5000, "nested too deeply"),
        ("<document><chunk>", "not valid XML"),
        (b"<?xml version='1.0' encoding='shift_jis'?><document/>", "not valid XML"),
        (export(known_scene(opencv()), "<calibration type='spherical'/>"), "spherical"),
        (export(known_scene(opencv()), ""), "expected a calibration"),
        (
            export(known_scene(opencv()), calibration(opencv())).replace(
                'sensor_id="0"', 'sensor_id="5"'
            ),
            "the sensor '5'",
        ),
        (export(known_scene(opencv()), calibration(opencv(), f=float("nan"))), "finite number"),
        (export(known_scene(opencv()), calibration(opencv(), k1=1e300)), "finite"),
        (
            export(known_scene(opencv()), calibration(opencv())).replace("p1.jpg", ""),
            "expected a file name",
        ),
    ],
)
def test_messages(tmp_path, content, message):
    file = write(tmp_path, content)
    with pytest.raises(UserError, match=message) as error:
        metashape.frames(file)
    assert error.value.file == file and error.value.fix
