"""Record3D: the unpacked folder of an ``.r3d`` export, with ``metadata`` and ``rgb/``.

``poses`` are camera to world with OpenGL axes, a quaternion x, y, z, w and a position each, for
``rgb/0.jpg``, ``rgb/1.jpg`` and so on. ``K`` is in columns, for images of ``w`` x ``h`` pixels;
``perFrameIntrinsicCoeffs`` has fx, fy, cx, cy of each. Source: Record3D's documentation of the
format and nerfstudio's ``record3d_utils.py``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.geometry.rotations import quat_to_rotation
from pipeline.io.poses.files import first_file, malformed, number, numbers, read_json
from pipeline.io.poses.frames import FLIP_YZ, Lens, PosedFrame, make_frame
from pipeline.io.poses.lenses import Brown, brown_camera

_NAMES = ("metadata", "metadata.json")


def find(folder: Path) -> str | None:
    if not (folder / "rgb").is_dir():
        return None
    return first_file(folder, _NAMES)


def frames(file: Path) -> list[PosedFrame]:
    """The frames of the metadata file.

    Raises:
        UserError: a malformed file.
    """
    content = read_json(file)
    poses = content.get("poses") if isinstance(content, dict) else None
    if not isinstance(poses, list) or not poses:
        raise malformed(file, "expected Record3D's metadata with a list 'poses', found none")
    lenses = _lenses(file, content, len(poses))
    found = []
    for i, entry in enumerate(poses):
        values = numbers(file, f"poses[{i}]", entry, 7)
        x, y, z, w = values[:4]
        if not 0.5 < np.abs(values[:4]).max() < 2:
            raise malformed(file, f"poses[{i}]: expected a unit quaternion")
        rotation = FLIP_YZ @ quat_to_rotation(np.array([w, x, y, z])).T
        found.append(make_frame(file, f"rgb/{i}", lenses[i], rotation, values[4:], f"poses[{i}]"))
    return found


def _lenses(file: Path, content: dict[str, Any], count: int) -> list[Lens]:
    width, height = (number(file, name, content.get(name, "")) for name in ("w", "h"))

    def lens(where: str, fx: float, fy: float, cx: float, cy: float) -> Lens:
        return Lens.fixed(brown_camera(file, where, width, height, Brown(fx, fy, cx, cy)))

    each = content.get("perFrameIntrinsicCoeffs")
    if isinstance(each, list) and len(each) == count:
        names = [f"perFrameIntrinsicCoeffs[{i}]" for i in range(count)]
        rows = [numbers(file, where, row, 4) for where, row in zip(names, each, strict=True)]
        return [lens(where, *row.tolist()) for where, row in zip(names, rows, strict=True)]
    k = numbers(file, "K", content.get("K", ""), 9)
    return [lens("K", k[0], k[4], k[6], k[7])] * count
