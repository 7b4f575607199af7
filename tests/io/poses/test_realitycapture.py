"""RealityCapture's CSV and XMP: axes, focal lengths for 36 mm, lens models, hostile files."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.cameras import Camera
from pipeline.geometry.lens_fit import fit_camera
from pipeline.io.poses import lenses
from pipeline.io.poses.frames import reconstruct
from pipeline.io.poses.realitycapture import csv_frames, xmp_frames
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import PosedImage, Reconstruction
from tests.io.poses.known import (
    FLIP_YZ,
    HEIGHT,
    UTM,
    WIDTH,
    check_same,
    known_scene,
    read,
)

HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"


def camera(*rest: float) -> Camera:
    params = np.array([500.0, 500.0, 322.5, 237.25, *rest])
    model = {0: "PINHOLE", 4: "OPENCV", 8: "FULL_OPENCV"}[len(rest)]
    return Camera(model, WIDTH, HEIGHT, params)


def film(lens: Camera) -> tuple[float, float, float]:
    f, _, cx, cy = lens.pinhole
    return f * 36 / WIDTH, (cx - WIDTH / 2) / WIDTH, (cy - HEIGHT / 2) / WIDTH


def angles(image: PosedImage) -> tuple[float, float, float]:
    """Heading, pitch and roll in degrees."""
    r = image.rotation.T @ FLIP_YZ  # = Rz(a) Rx(b) Ry(c), whose last row is (-cb sc, sb, cb cc)
    a, b, c = np.arctan2(-r[0, 1], r[1, 1]), np.arcsin(r[2, 1]), np.arctan2(-r[2, 0], r[2, 2])
    return -float(np.degrees(a)), float(np.degrees(b)), float(np.degrees(c))


def csv_text(known: Reconstruction, *, k4: float = 0.0, first: str = "") -> str:
    lines = [*([first] if first else []), HEADER]
    for image in known.images.values():
        lens = known.cameras[image.camera_id]
        k1, k2, t1, t2, k3, *_ = (*lens.params[4:].tolist(), 0, 0, 0, 0, 0)
        row = [*image.centre.tolist(), *angles(image), *film(lens), k1, k2, k3, k4, t1, t2]
        lines.append(",".join([image.name, *map(repr, row)]))
    return "\r\n".join(lines) + "\r\n"


def xmp_text(known: Reconstruction, image: PosedImage, model: str, coefficients: str) -> str:
    f, u, v = film(known.cameras[1])
    rotation = " ".join(map(repr, image.rotation.ravel().tolist()))
    position = " ".join(map(repr, image.centre.tolist()))
    return f"""<x:xmpmeta xmlns:x="adobe:ns:meta/">
  <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
    <rdf:Description xcr:Version="3" xcr:PosePrior="initial" xcr:Coordinates="absolute"
       xcr:DistortionModel="{model}" xcr:FocalLength35mm="{f!r}"
       xcr:Skew="0" xcr:AspectRatio="1" xcr:PrincipalPointU="{u!r}"
       xcr:PrincipalPointV="{v!r}" xcr:CalibrationPrior="initial"
       xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">
      <xcr:Rotation>{rotation}</xcr:Rotation>
      <xcr:Position>{position}</xcr:Position>
      <xcr:DistortionCoeficients>{coefficients}</xcr:DistortionCoeficients>
    </rdf:Description>
  </rdf:RDF>
</x:xmpmeta>
"""


def write_xmp(folder, known: Reconstruction, model: str, coefficients: str) -> None:
    (folder / "images").mkdir(exist_ok=True)
    for image in known.images.values():
        text = xmp_text(known, image, model, coefficients)
        (folder / "images" / f"{image.name}.xmp").write_text(text)
    (folder / "images" / "other.xmp").write_text("<x:xmpmeta xmlns:x='adobe:ns:meta/'/>")


@pytest.mark.parametrize("first", ["", "#cameras 4"])
@pytest.mark.parametrize(
    "lens",
    [
        camera(),
        camera(-0.1, 0.03, 1e-3, -2e-3),
        camera(-0.1, 0.03, 1e-3, -2e-3, 0.01, 0, 0, 0),
    ],
    ids=["pinhole", "opencv", "k3"],
)
def test_known_cameras_are_read_back_from_csv(tmp_path, lens, first):
    known = known_scene(lens, origin=UTM)
    (tmp_path / "cameras.csv").write_text(csv_text(known, first=first))
    check_same(read("realitycapture_csv", tmp_path), known)


def test_a_fourth_coefficient_is_fitted(tmp_path):
    known = known_scene(camera(-0.1, 0.03, 1e-3, -2e-3), 2)
    (tmp_path / "cameras.csv").write_text(csv_text(known, k4=1e-3))
    found = read("realitycapture_csv", tmp_path)
    assert {entry.model for entry in found.cameras.values()} == {"FULL_OPENCV"}


@pytest.mark.parametrize(
    ("lens", "model", "coefficients"),
    [
        (camera(), "perspective", "0 0 0 0 0 0"),
        (camera(-0.1, 0.03, 0, 0, 0.01, 0, 0, 0), "brown3", "-0.1 0.03 0.01 0 0 0"),
        (camera(-0.1, 0.03, 1e-3, -2e-3), "brown4t2", "-0.1 0.03 0 0 0.001 -0.002"),
        (
            Camera("SIMPLE_DIVISION", WIDTH, HEIGHT, np.array([500, 322.5, 237.25, -0.1])),
            "division",
            "-0.1 0 0 0 0 0",
        ),
    ],
    ids=["perspective", "brown3", "brown4t2", "division"],
)
def test_known_cameras_are_read_back_from_xmp(tmp_path, lens, model, coefficients):
    known = known_scene(lens, origin=UTM, names="p{}")
    write_xmp(tmp_path, known, model, coefficients)
    check_same(read("realitycapture_xmp", tmp_path), known)


def test_properties_may_be_attributes(tmp_path):
    known = known_scene(camera(), names="p{}")
    write_xmp(tmp_path, known, "perspective", "0 0 0 0 0 0")
    for file in (tmp_path / "images").glob("p*.xmp"):
        text, moved = file.read_text(), ""
        for name in ("Rotation", "Position", "DistortionCoeficients"):
            start, end = text.index(f"<xcr:{name}>"), text.index(f"</xcr:{name}>")
            moved += f' xcr:{name}="{text[start + len(name) + 6 : end]}"'
            text = text[:start] + text[end + len(name) + 7 :]
        file.write_text(text.replace(' xcr:Skew="0"', moved))
    check_same(read("realitycapture_xmp", tmp_path), known)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("a.jpg,1,2,3,0,0,0,nan,0,0,0,0,0,0,0,0", "line 2: f: expected a finite number"),
        ("a.jpg,1,2,3", "expected 16 columns, found 4"),
        (",1,2,3,0,0,0,30,0,0,0,0,0,0,0,0", "expected a file name"),
        ("a.jpg,1e13,2,3,0,0,0,30,0,0,0,0,0,0,0,0", "finite position"),
        ("", "found none"),
    ],
)
def test_messages_of_csv(tmp_path, row, message):
    file = tmp_path / "cameras.csv"
    file.write_text(f"{HEADER}\n{row}\n")
    with pytest.raises(UserError, match=message) as error:
        csv_frames(file)
    assert error.value.file == file


def test_an_unknown_lens_model_is_an_error(tmp_path):
    write_xmp(tmp_path, known_scene(camera(), names="p{}"), "kannala", "0 0 0 0 0 0")
    with pytest.raises(UserError, match="DistortionModel kannala"):
        xmp_frames(tmp_path / "images")


@pytest.mark.parametrize("form", ["csv", "xmp"])
def test_photographs_with_one_lens_are_fitted_once(tmp_path, monkeypatch, form):
    """A fit takes a tenth of a second, and there are thousands of photographs."""
    calls = []

    def counted(*arguments):
        calls.append(arguments)
        return fit_camera(*arguments)

    monkeypatch.setattr(lenses, "fit_camera", counted)
    lenses._nearest.cache_clear()
    known = known_scene(camera(-0.1, 0.03, 1e-3, -2e-3), 9, names="p{}")
    if form == "csv":
        (tmp_path / "cameras.csv").write_text(csv_text(known, k4=1e-3))
        frames = csv_frames(tmp_path / "cameras.csv")
    else:
        write_xmp(tmp_path, known, "brown4t2", "-0.1 0.03 0 1e-3 0.001 -0.002")
        frames = xmp_frames(tmp_path / "images")
    sizes = dict.fromkeys(known.by_name(), (WIDTH, HEIGHT))
    assert len(reconstruct(frames, sizes).images) == 9 and len(calls) == 1


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_the_csv_may_have_any_unicode_encoding(tmp_path, encoding):
    known = known_scene(camera())
    (tmp_path / "cameras.csv").write_bytes(csv_text(known).encode(encoding))
    check_same(read("realitycapture_csv", tmp_path), known)
