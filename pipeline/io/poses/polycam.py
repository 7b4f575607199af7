"""Polycam: the folder ``keyframes/`` of "Raw data" with one JSON file an image.

``t_00`` to ``t_23`` are the rows of camera to world with OpenGL axes, as in ARKit. Polycam's
optimised poses and images are in ``corrected_cameras`` and ``corrected_images``. Source:
nerfstudio's ``polycam_utils.py`` and Polycam's "Poly Form" repository.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.io.poses.files import malformed, number, read_json
from pipeline.io.poses.frames import FLIP_YZ, Lens, PosedFrame, make_frame
from pipeline.io.poses.lenses import Brown, brown_camera

_FOLDERS = {"corrected_cameras": "corrected_images", "cameras": "images"}


def find(folder: Path) -> str | None:
    for cameras, images in _FOLDERS.items():
        path = folder / "keyframes" / cameras
        if (folder / "keyframes" / images).is_dir() and path.is_dir() and files(path):
            return f"keyframes/{cameras}"
    return None


def files(path: Path) -> list[Path]:
    return sorted(file for file in path.glob("*.json") if file.is_file())


def frames(path: Path) -> list[PosedFrame]:
    """The frames in the folder ``keyframes/corrected_cameras`` or ``keyframes/cameras``.

    Raises:
        UserError: a malformed file.
    """
    images = f"keyframes/{_FOLDERS[path.name]}"
    found = []
    for file in files(path):
        content = read_json(file)
        if not isinstance(content, dict):
            raise malformed(file, "expected an object with the camera, found none")
        names = [f"t_{row}{column}" for row in range(3) for column in range(4)]
        values = {
            name: number(file, name, content.get(name, ""))
            for name in (*names, "fx", "fy", "cx", "cy", "width", "height")
        }
        *rows, fx, fy, cx, cy, width, height = values.values()
        camera = brown_camera(file, file.stem, width, height, Brown(fx, fy, cx, cy))
        pose = np.array(rows).reshape(3, 4)
        rotation = FLIP_YZ @ pose[:, :3].T
        name = f"{images}/{file.stem}"
        found.append(make_frame(file, name, Lens.fixed(camera), rotation, pose[:, 3]))
    return found
