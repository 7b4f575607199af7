"""PatchMatch stereo: Python interface of csrc/patchmatch.cpp.

The library is compiled at first use, or beforehand by ``python -m pipeline.mvs.patchmatch`` (with
``--target`` for other processors).
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.runtime.native import NativeLibrary, build_main
from pipeline.scene.views import View

LIBRARY = NativeLibrary(
    name="stereo kernel",
    file="libstereo.so",
    sources=Path(__file__).parent / "csrc",
    # The last flags silence GCC about its own headers, and clang about options of GCC.
    flags=(
        *("-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast"),
        *("-fPIC", "-Wall", "-Wno-psabi", "-Wno-maybe-uninitialized"),
        "-Wno-unknown-warning-option",
    ),
)


# Limits of the kernel.
MAX_RADIUS, MAX_BEST = 8, 4


@dataclass(frozen=True)
class Picture:
    """A view with its pixels.

    Attributes:
        view: the camera, at the size of the arrays.
        grey: (H, W) uint8.
        valid: (H, W) bool; False for excluded pixels, which get no plane and no weight.
    """

    view: View
    grey: NDArray[np.uint8]
    valid: NDArray[np.bool_]


@dataclass(frozen=True)
class CostOptions:
    """Parameters of the matching cost.

    Attributes:
        radius: Half the side of the window, pixels; every second row and column is used.
        sigma_color: The scale of the bilateral weights in grey levels.
        sigma_space: The scale of the bilateral weights in pixels.
        num_best: The cost of a plane is the mean of this number of lowest costs of sources.
        min_cosine: The smallest cosine of the angle between normal and viewing direction.
    """

    radius: int = 5
    sigma_color: float = 12.0
    sigma_space: float = 5.0
    num_best: int = 2
    min_cosine: float = 0.1


@dataclass(frozen=True)
class SearchOptions:
    """Parameters of the search at one resolution.

    Attributes:
        depth_range: Smallest and largest camera z, world units.
        iterations: The number of times that both colours of the checkerboard are updated.
        num_random: The number of random planes of each pixel before the first iteration.
        first_step: The first perturbation, pixels of a source; halved in each iteration.
        seed: The seed of random numbers, at most 32 bits, with which pixel and iteration are
            hashed.
    """

    depth_range: tuple[float, float]
    iterations: int
    num_random: int
    first_step: float
    seed: int


class _Source(ctypes.Structure):
    _fields_ = [
        ("grey", ctypes.c_void_p),
        ("width", ctypes.c_int32),
        ("height", ctypes.c_int32),
        ("rotation", ctypes.c_float * 9),
        ("translation", ctypes.c_float * 3),
    ]


_INTEGERS = "width height num_sources num_best radius iterations num_random"
_FLOATS = (
    "sigma_color sigma_space fx fy cx cy min_inverse_depth max_inverse_depth pixel_step min_cosine "
    "first_step"
)


class _Problem(ctypes.Structure):
    _fields_ = [
        ("grey", ctypes.c_void_p),
        ("valid", ctypes.c_void_p),
        ("sources", ctypes.POINTER(_Source)),
        *((name, ctypes.c_int32) for name in _INTEGERS.split()),
        ("seed", ctypes.c_uint32),
        *((name, ctypes.c_float) for name in _FLOATS.split()),
    ]


def patchmatch(
    reference: Picture,
    sources: Sequence[Picture],
    planes: NDArray[np.float32],
    search: SearchOptions,
    cost: CostOptions,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Improve the planes of a view's pixels. Releases the GIL.

    Args:
        sources: At least one source.
        planes: (3, H, W) inverse depth at the pixel's centre and its gradient per pixel, world
            units; inverse depth 0 for pixels without a plane.

    Returns:
        (3, H, W) planes, and their (H, W) costs in [0, 2]: 1 minus the weighted NCC. Pixels without
        a plane have inverse depth 0 and cost 2.

    Raises:
        UserError: the library is not compiled and cannot be.
    """
    problem, _kept = _problem(reference, sources, search, cost)
    found = np.array(planes, np.float32, order="C")
    if found.shape != (3, *reference.grey.shape):
        raise ValueError(f"expected planes of shape (3, H, W), found {found.shape}")
    costs = np.empty(reference.grey.shape, np.float32)
    pointers = (array.ctypes.data_as(ctypes.c_void_p) for array in (found, costs))
    _library().patchmatch(ctypes.byref(problem), *pointers)
    return found, costs


def relative_pose(view: View, other: View) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(3, 3) R and (3,) t: the point X of the view's camera is R X + t in the other's."""
    rotation = other.world_to_camera[:3, :3] @ view.world_to_camera[:3, :3].T
    return rotation, other.world_to_camera[:3, 3] - rotation @ view.world_to_camera[:3, 3]


def relative_projection(
    reference: View, source: View
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(3, 3) K_s R K_r^-1 and (3,) K_s t: the pixel (x, y) of the reference with inverse depth w is
    at the homogeneous pixel ``rotation @ (x, y, 1) + translation * w`` of the source."""
    rotation, translation = relative_pose(reference, source)
    fx, fy = reference.fx, reference.fy
    inverse = np.array(
        [[1 / fx, 0.0, -reference.cx / fx], [0.0, 1 / fy, -reference.cy / fy], [0.0, 0.0, 1.0]]
    )
    matrix = np.array([[source.fx, 0.0, source.cx], [0.0, source.fy, source.cy], [0.0, 0.0, 1.0]])
    return matrix @ rotation @ inverse, matrix @ translation


def pixel_step(reference: View, sources: Sequence[View], depth: float) -> float:
    """The change of the inverse depth that moves the point at the image centre at this depth by
    one pixel, in the median of the sources."""
    centre = np.array([reference.width / 2, reference.height / 2, 1.0])
    steps = []
    for source in sources:
        rotation, translation = relative_projection(reference, source)
        at = rotation @ centre + translation / depth
        motion = (translation[:2] * at[2] - at[:2] * translation[2]) / max(at[2] ** 2, 1e-12)
        steps.append(1.0 / max(float(np.linalg.norm(motion)), 1e-9))
    return float(np.median(steps))


def _problem(
    reference: Picture, sources: Sequence[Picture], search: SearchOptions, cost: CostOptions
) -> tuple[_Problem, list[object]]:
    """The kernel's input, and the arrays that it refers to."""
    if not sources:
        raise ValueError("expected at least one source")
    if not (0 < cost.radius <= MAX_RADIUS and 0 < cost.num_best <= MAX_BEST):
        raise ValueError(f"expected a radius up to {MAX_RADIUS}, num_best up to {MAX_BEST}")
    array = (_Source * len(sources))()
    kept: list[object] = [array]
    for item, source in zip(array, sources, strict=True):
        grey = np.ascontiguousarray(source.grey, np.uint8)
        kept.append(grey)
        item.grey = grey.ctypes.data
        item.height, item.width = grey.shape
        rotation, translation = relative_projection(reference.view, source.view)
        item.rotation[:] = rotation.ravel().tolist()
        item.translation[:] = translation.tolist()
    grey = np.ascontiguousarray(reference.grey, np.uint8)
    valid = np.ascontiguousarray(reference.valid, np.uint8)
    kept += [grey, valid]
    view, (near, far) = reference.view, search.depth_range
    views = [source.view for source in sources]
    options = vars(cost) | vars(search)
    del options["depth_range"]
    problem = _Problem(
        grey=grey.ctypes.data,
        valid=valid.ctypes.data,
        sources=array,
        width=view.width,
        height=view.height,
        num_sources=len(sources),
        fx=view.fx,
        fy=view.fy,
        cx=view.cx,
        cy=view.cy,
        min_inverse_depth=1.0 / far,
        max_inverse_depth=1.0 / near,
        pixel_step=pixel_step(view, views, 2.0 / (1.0 / near + 1.0 / far)),
        **options,
    )
    return problem, kept


@cache
def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(str(LIBRARY.build().path))
    library.patchmatch.restype = None
    return library


if __name__ == "__main__":
    sys.exit(build_main(lambda: LIBRARY))
