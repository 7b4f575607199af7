"""RealityCapture and RealityScan: "Internal/External camera parameters" (CSV), XMP sidecars.

Both give the focal length for a film 36 mm wide, f / 36 of the photograph's longer side in pixels;
the principal point is a fraction of that side from the image centre. Distortion is Brown-Conrady
with the coefficients k1 to k4, t1 and t2 (OpenCV's p1 and p2), or the division model, whose
undistorted radius is r / (1 + k1 r^2).

In the CSV, heading, pitch and roll are camera to world with OpenGL axes: Rz(-heading) Rx(pitch)
Ry(roll), degrees. In XMP, Rotation is world to camera with COLMAP's axes, Position the centre.
Sources: nerfstudio's ``realitycapture_utils.py``; AliceVision's ``importKnownPoses`` and
``exportDistortion``; RealityCapture's help, "XMP Metadata".
"""

from __future__ import annotations

import csv
import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from pipeline.geometry.cameras import Camera
from pipeline.io.poses.files import (
    find_by_head,
    malformed,
    number,
    numbers,
    read_head,
    read_text,
    read_xml,
)
from pipeline.io.poses.frames import FLIP_YZ, Lens, PosedFrame, checked_camera, make_frame, turned
from pipeline.io.poses.lenses import Brown, scaled_lens

_REQUIRED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
_OPTIONAL = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
_FILM_MM = 36.0
# Folders of photographs that XMP files may be beside.
_PHOTO_FOLDERS = ("images", ".")


def find_csv(folder: Path) -> str | None:
    return find_by_head(folder, ".csv", lambda head: _header(_text(head)) is not None)


def csv_frames(file: Path) -> list[PosedFrame]:
    """The rows of the CSV file.

    Raises:
        UserError: Rows are malformed.
    """
    content = read_text(file)
    header = _header(content)
    if header is None:
        raise malformed(file, f"expected the columns {', '.join(_REQUIRED)}, found others")
    columns = {name: i for i, name in enumerate(header)}
    found = []
    for line, text in enumerate(content.splitlines(), 1):
        row = _cells(text)
        if not row:
            continue
        if len(row) < len(header):
            raise malformed(file, f"line {line}: expected {len(header)} columns, found {len(row)}")
        where = f"line {line}"

        def value(name: str, row: list[str] = row, where: str = where) -> float:
            text = row[columns[name]].strip() if name in columns else "0"
            return number(file, f"{where}: {name}", text)

        to_world = (
            turned(2, -value("heading")) @ turned(0, value("pitch")) @ turned(1, value("roll"))
        )
        centre = np.array([value("x"), value("y"), value("alt")])
        f, px, py, *k, t1, t2 = (value(name) for name in ("f", *_OPTIONAL))
        lens = _lens(file, where, Brown(f, f, px, py, k=tuple(k), p=(t1, t2)))
        name = row[columns["name"]].strip()
        found.append(make_frame(file, name, lens, FLIP_YZ @ to_world.T, centre, where))
    if not found:
        raise malformed(file, "expected a camera in each line, found none")
    return found


def find_xmp(folder: Path) -> str | None:
    return next((name for name in _PHOTO_FOLDERS if xmp_files(folder / name)), None)


def xmp_files(path: Path) -> list[Path]:
    """The XMP files in a folder and its subfolders that have a pose."""
    if not path.is_dir():
        return []
    found = [
        Path(folder) / name
        for folder, _, names in os.walk(path)
        for name in names
        if name.lower().endswith(".xmp")
    ]
    return [file for file in sorted(found) if file.is_file() and _has_pose(file)]


def xmp_frames(path: Path) -> list[PosedFrame]:
    """The cameras of the XMP files in a folder and its subfolders, named by their paths in it.

    Raises:
        UserError: a malformed file, or a lens that is not supported.
    """
    return [_of_xmp(file, file.relative_to(path)) for file in xmp_files(path)]


def _has_pose(file: Path) -> bool:
    head = read_head(file)
    return b"xcr:Rotation" in head and b"xcr:Position" in head


def _of_xmp(file: Path, name: Path) -> PosedFrame:
    root = read_xml(file)
    found = [e for e in root.iter() if _field(e, "Rotation") and _field(e, "Position")]
    if not found:
        raise malformed(file, "expected xcr:Rotation and xcr:Position, found none")
    entry = found[0]
    rotation = numbers(file, "xcr:Rotation", _field(entry, "Rotation"), 9).reshape(3, 3)
    centre = numbers(file, "xcr:Position", _field(entry, "Position"), 3)
    names = ("FocalLength35mm", "PrincipalPointU", "PrincipalPointV", "Skew", "AspectRatio")
    standard = {"FocalLength35mm": "", "AspectRatio": "1"}
    focal, u, v, skew, aspect = (
        number(file, f"xcr:{name}", _field(entry, name) or standard.get(name, "0"))
        for name in names
    )
    if skew or aspect != 1:
        raise malformed(file, "expected square pixels without skew (xcr:Skew, xcr:AspectRatio)")
    words = (_field(entry, "DistortionCoeficients") or "0 0 0 0 0 0").split()
    coefficients = numbers(file, "xcr:DistortionCoeficients", words, len(words)).tolist()
    k, t = (*coefficients[:4], 0.0, 0.0, 0.0, 0.0)[:4], (*coefficients[4:6], 0.0, 0.0)[:2]
    model = (_field(entry, "DistortionModel") or "perspective").lower()
    if model == "division":
        if any(k[1:]) or any(t):
            raise malformed(file, "division: expected one coefficient, found several")
        lens = Lens("SIMPLE_DIVISION", partial(_division, file, focal, (u, v), k[0]))
    elif model == "perspective" or model.startswith("brown"):
        lens = _lens(file, file.name, Brown(focal, focal, u, v, k=k, p=(t[0], t[1])))
    else:
        raise malformed(
            file,
            f"xcr:DistortionModel {model[:40]} is not supported; expected perspective, brown3, "
            "brown4, with or without tangential coefficients, or division",
        )
    return make_frame(file, name.with_suffix("").as_posix(), lens, rotation, centre)


def _field(element: Element, name: str) -> str | None:
    """The text of a property, which RealityCapture writes as an attribute or as an element."""
    return element.get(_XCR + name) or element.findtext(_XCR + name)


def _lens(file: Path, where: str, film: Brown) -> Lens:
    """The lens, whose focal length is that for the film, and whose principal point is in parts of
    the photograph's longer side."""
    return scaled_lens(
        file, where, replace(film, fx=film.fx / _FILM_MM, fy=film.fy / _FILM_MM), max
    )


def _division(
    file: Path, focal: float, point: tuple[float, float], k: float, width: int, height: int
) -> Camera:
    side = max(width, height)
    x, y = width / 2 + point[0] * side, height / 2 + point[1] * side
    params = (focal / _FILM_MM * side, x, y, k)
    return checked_camera(file, file.name, "SIMPLE_DIVISION", width, height, params)


def _cells(line: str) -> list[str]:
    """The cells of a line; empty for comments and blank lines."""
    if line.startswith("#") or not line.strip():
        return []
    try:
        return next(csv.reader([line]), [])
    except csv.Error:
        return [line]  # A cell that is longer than any name.


def _text(head: bytes) -> str:
    return head.decode("utf-8-sig", errors="replace")


def _header(content: str) -> list[str] | None:
    """The names of the columns, in the first or, after "#cameras N", the second line."""
    for line in content.splitlines()[:2]:
        names = [name.strip().lstrip("#").lower() for name in line.split(",")]
        if all(name in names for name in _REQUIRED):
            return names
    return None
