"""COLMAP's camera models and the intrinsics of a camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# COLMAP's camera models: name -> (id in binary files, names of the parameters in order).
# Source: COLMAP's documentation, "Camera Models".
CAMERA_MODELS: dict[str, tuple[int, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (0, ("f", "cx", "cy")),
    "PINHOLE": (1, ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": (2, ("f", "cx", "cy", "k")),
    "RADIAL": (3, ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": (4, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": (5, ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    "FULL_OPENCV": (
        6,
        ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    ),
    "FOV": (7, ("fx", "fy", "cx", "cy", "omega")),
    "SIMPLE_RADIAL_FISHEYE": (8, ("f", "cx", "cy", "k")),
    "RADIAL_FISHEYE": (9, ("f", "cx", "cy", "k1", "k2")),
    "THIN_PRISM_FISHEYE": (
        10,
        ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        11,
        (
            *("fx", "fy", "cx", "cy", "k0", "k1", "k2", "k3", "k4", "k5"),
            *("p0", "p1", "s0", "s1", "s2", "s3"),
        ),
    ),
    "SIMPLE_DIVISION": (12, ("f", "cx", "cy", "k")),
    "DIVISION": (13, ("fx", "fy", "cx", "cy", "k")),
    "SIMPLE_FISHEYE": (14, ("f", "cx", "cy")),
    "FISHEYE": (15, ("fx", "fy", "cx", "cy")),
    "EUCM": (16, ("fx", "fy", "cx", "cy", "alpha", "beta")),
    "EQUIRECTANGULAR": (17, ("w", "h")),
}
_WITH_TWO_FOCAL_LENGTHS = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "SIMPLE_DIVISION": "DIVISION",
    "SIMPLE_FISHEYE": "FISHEYE",
}


@dataclass(frozen=True)
class Camera:
    """The intrinsics of a camera.

    Attributes:
        model: A key of ``CAMERA_MODELS``.
        width, height: The image size in pixels.
        params: (K,) float64 in the model's order; focal lengths and principal point in pixels,
            distortion coefficients for normalised coordinates.
    """

    model: str
    width: int
    height: int
    params: NDArray[np.float64]

    @property
    def is_spherical(self) -> bool:
        """Whether the image is an equirectangular panorama, 360 by 180 degrees."""
        return self.model == "EQUIRECTANGULAR"

    @property
    def is_pinhole(self) -> bool:
        """Whether this is a perspective camera whose distortion coefficients are all zero."""
        if self.model in ("SIMPLE_PINHOLE", "PINHOLE"):
            return True
        if self.is_spherical:
            return False
        return "FISHEYE" not in self.model and not np.any(self.distortion)

    @property
    def intrinsics_names(self) -> tuple[str, ...]:
        """The leading parameters' names: focal lengths and principal point, no distortion; width
        and height for a panorama."""
        names = CAMERA_MODELS[self.model][1]
        return names[:3] if names[0] == "f" else names[:4]

    @property
    def distortion(self) -> NDArray[np.float64]:
        """(K,) the distortion coefficients, which follow the intrinsics."""
        return self.params[len(self.intrinsics_names) :]

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """(fx, fy, cx, cy) in pixels, without the distortion; for a panorama, those of a camera
        with the angular resolution of its centre."""
        p = [float(v) for v in self.params]
        if self.is_spherical:
            return p[0] / (2 * np.pi), p[1] / np.pi, p[0] / 2, p[1] / 2
        if self.intrinsics_names[0] == "f":
            return p[0], p[0], p[1], p[2]
        return p[0], p[1], p[2], p[3]

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the same image resized to ``width`` x ``height`` pixels.

        A model with one focal length becomes one with two if the aspect ratio changes.
        """
        if self.is_spherical:
            return Camera(self.model, width, height, np.array([width, height], np.float64))
        sx, sy = width / self.width, height / self.height
        fx, fy, cx, cy = self.pinhole
        rest = self.distortion
        if self.intrinsics_names[0] == "f" and abs(sx - sy) < 1e-9 * sx:
            params = np.array([fx * sx, cx * sx, cy * sy, *rest])
            return Camera(self.model, width, height, params)
        model = _WITH_TWO_FOCAL_LENGTHS.get(self.model, self.model)
        if model == "OPENCV" and len(rest) < 4:
            rest = np.concatenate([rest, np.zeros(4 - len(rest))])
        if self.model.endswith("RADIAL_FISHEYE"):
            model, rest = "OPENCV_FISHEYE", np.concatenate([rest, np.zeros(4 - len(rest))])
        return Camera(model, width, height, np.array([fx * sx, fy * sy, cx * sx, cy * sy, *rest]))
