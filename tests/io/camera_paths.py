"""Camera paths as splatmake, nerfstudio and splat-transform write them, all of the same two
cameras: at (1, 2, 3) looking along x, and at (2, 2, 3) looking along y, with z up."""

from __future__ import annotations

import numpy as np

from pipeline.io.camera_paths import PathFile

CENTRES = np.array([[1.0, 2.0, 3.0], [2.0, 2.0, 3.0]])
#: Camera to world: right, down, forward as columns.
AXES = np.array(
    [
        [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    ],
    float,
)
FOV = np.degrees(2 * np.arctan([0.5, 0.25]))


def world_to_camera() -> np.ndarray:
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, :3] = AXES.transpose(0, 2, 1)
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", poses[:, :3, :3], CENTRES)
    return poses


def path_file(**changes: object) -> PathFile:
    fields = {
        "convention": "",
        "fps": 24,
        "width": 64,
        "height": 48,
        "fx": 48.0,
        "fy": 48.0,
        "cx": 32.0,
        "cy": 24.0,
        "focal_factors": (1.0, 2.0),
        "world_to_camera": world_to_camera().tolist(),
    }
    return PathFile.model_validate(fields | changes)


def _opengl(index: int) -> list[float]:
    pose = np.eye(4)
    pose[:3, :3] = AXES[index] @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = CENTRES[index]
    return [float(value) for value in pose.ravel()]


NERFSTUDIO = {
    "camera_type": "perspective",
    "render_height": 48,
    "render_width": 64,
    "fps": 24,
    "seconds": 2,
    "smoothness_value": 0.5,
    "keyframes": [],
    "camera_path": [
        {"camera_to_world": _opengl(i), "fov": float(FOV[i]), "aspect": 1.3} for i in range(2)
    ],
}

# x and y are negated: splat-transform turns a PLY file by 180 degrees about z.
FRAMES = {
    "frameRate": 24,
    "frames": [
        {"position": [-1, -2, 3], "target": [-5, -2, 3], "up": [0, 0, 1], "fov": float(FOV[0])},
        {"position": [-2, -2, 3], "target": [-2, -9, 3], "up": [0, 0, 2], "fov": float(FOV[1])},
    ],
}
