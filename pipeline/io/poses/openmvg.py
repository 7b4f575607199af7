"""OpenMVG: ``sfm_data.json`` (openMVG_main_ConvertSfM_DataFormat writes it from ``.bin``).

Extrinsics are a rotation, world to camera with COLMAP's axes, and the centre. Intrinsics are
pinhole cameras with ``disto_k1``, ``disto_k3``, ``disto_t2`` (k1, k2, k3, and OpenCV's p1 and p2)
or ``fisheye`` (OpenCV's k1 to k4). Source: OpenMVG's documentation, "sfm: Structure from Motion",
and its ``cameras`` module.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.io.poses.files import first_file, malformed, number, numbers, read_json
from pipeline.io.poses.frames import Lens, PosedFrame, make_frame
from pipeline.io.poses.lenses import Brown, brown_camera
from pipeline.runtime.text import shown

_FILE = "sfm_data.json"
_COEFFICIENTS = {"disto_k1": 1, "disto_k3": 3, "disto_t2": 5, "fisheye": 4}


def find(folder: Path) -> str | None:
    return first_file(folder, [_FILE])


def frames(file: Path) -> list[PosedFrame]:
    """The views that have a pose and intrinsics.

    Raises:
        UserError: a malformed file, no such view, or a camera that is not supported.
    """
    content = read_json(file)
    views, intrinsics, extrinsics = (
        _entries(file, content, name) for name in ("views", "intrinsics", "extrinsics")
    )
    found = []
    for view in views.values():
        pose, camera = view.get("id_pose"), view.get("id_intrinsic")
        name = view.get("filename")
        if not isinstance(name, str) or not isinstance(view.get("local_path", ""), str):
            raise malformed(file, "expected views with a filename")
        if not isinstance(pose, int) or not isinstance(camera, int):
            raise malformed(file, f"view {shown(name)}: expected id_pose and id_intrinsic")
        if pose not in extrinsics or camera not in intrinsics:
            continue
        where = f"view {shown(name)}"
        lens = _lens(file, f"intrinsic {camera}", intrinsics[camera])
        matrix = extrinsics[pose].get("rotation")
        rows = matrix if isinstance(matrix, list) and len(matrix) == 3 else [None] * 3
        rotation = np.stack([numbers(file, f"{where}: rotation", row, 3) for row in rows])
        centre = numbers(file, f"{where}: center", extrinsics[pose].get("center"), 3)
        path = f"{view.get('local_path') or '.'}/{name}"
        found.append(make_frame(file, path, lens, rotation, centre, where))
    if not found:
        raise malformed(file, "expected views with a pose (extrinsics), found none")
    return found


def _entries(file: Path, content: Any, name: str) -> dict[int, dict[str, Any]]:
    """Key -> fields of a list of OpenMVG's maps, without the levels that hold pointers."""
    listed = content.get(name) if isinstance(content, dict) else None
    if not isinstance(listed, list):
        raise malformed(file, f"expected OpenMVG's list {name!r}, found none")
    found: dict[int, dict[str, Any]] = {}
    for entry in listed:
        key = entry.get("key") if isinstance(entry, dict) else None
        if not isinstance(key, int):
            raise malformed(file, f"{name}: expected entries with a key and a value")
        fields: dict[str, Any] = {}
        _flatten(entry.get("value"), fields, 6)
        found[key] = fields
    return found


def _flatten(value: Any, into: dict[str, Any], levels: int) -> None:
    if isinstance(value, dict) and levels:
        for name, inner in value.items():
            if isinstance(inner, dict):
                _flatten(inner, into, levels - 1)
            else:
                into.setdefault(name, inner)


def _lens(file: Path, where: str, fields: Mapping[str, Any]) -> Lens:
    if "focal_length" not in fields:
        raise malformed(
            file,
            f"{where}: expected a pinhole or fisheye camera with focal_length; spherical cameras "
            "are not supported",
            fix="export perspective photographs (openMVG_main_openMVGSpherical2Cubic), or set "
            "poses: ignore",
        )
    width, height, focal = (
        number(file, f"{where}: {name}", fields.get(name))
        for name in ("width", "height", "focal_length")
    )
    cx, cy = numbers(file, f"{where}: principal_point", fields.get("principal_point"), 2).tolist()
    kind = next((name for name in _COEFFICIENTS if name in fields), None)
    values: list[float] = []
    if kind is not None:
        values = numbers(file, f"{where}: {kind}", fields[kind], _COEFFICIENTS[kind]).tolist()
    tangential = (values[3], values[4]) if kind == "disto_t2" else (0.0, 0.0)
    radial = tuple(values if kind == "fisheye" else values[:3])
    lens = Brown(focal, focal, cx, cy, k=radial, p=tangential, fisheye=kind == "fisheye")
    return Lens.fixed(brown_camera(file, where, width, height, lens))
