"""The form of a checkpoint's arrays: names, types and shapes.

A digest shows that a file is whole. It does not show that this version of the program wrote it, and
the native operators do not check what they are given.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]

# The number of spherical harmonics grows during training, and may be any of these.
_HARMONICS = "sh"
_BANDS = (1, 4, 9, 16)
_ROWS = ("parameter.", "first.", "second.")
# These arrays have one number a Gaussian, or none before the first step of density control.
_STATISTICS = frozenset({"gradient_sum", "seen"})


def check_arrays(arrays: Arrays, like: Arrays) -> None:
    """Check the arrays of a checkpoint.

    Args:
        like: The arrays of the run before its first step. Only the number of Gaussians and of
            spherical harmonics may differ.

    Raises:
        ValueError: An array is missing, or has another type or shape.
    """
    if arrays.keys() != like.keys():
        name = min(arrays.keys() ^ like.keys())
        raise ValueError(f"the array {name[:60]} is {'missing' if name in like else 'unknown'}")
    means = arrays["parameter.means"]
    count = len(means) if means.ndim else 0
    if not count:
        raise ValueError("there are no Gaussians")
    bands = arrays["parameter.sh"].shape[1:2]
    for name, array in arrays.items():
        expected = _shape(name, like[name], count, bands)
        empty = name in _STATISTICS and array.shape == (0,)
        if array.dtype != like[name].dtype or not (array.shape == expected or empty):
            raise ValueError(
                f"the array {name} is {array.dtype} {array.shape}, not "
                f"{like[name].dtype} {expected}"
            )
    order = arrays["order"]
    if not (np.sort(order) == np.arange(len(order))).all():
        raise ValueError("the order of the views is no permutation")


def check_position(values: Mapping[str, Any], views: int) -> None:
    """Check the position in the schedule.

    Args:
        views: The number of training views.

    Raises:
        ValueError: The position is not one of a run with these views.
    """
    position, clock = values["position"], values["clock"]
    if type(position) is not int or not 0 <= position <= views:
        raise ValueError("the position is not one of the views")
    if type(clock) is not int or clock < 0:
        raise ValueError("the position in the schedule is not a number of steps")


def _shape(
    name: str, like: NDArray[Any], count: int, bands: tuple[int, ...]
) -> tuple[int, ...] | None:
    """The shape that an array has with ``count`` Gaussians; None if it can have none."""
    if name in _STATISTICS:
        return (count,)
    if name == "last" or name.startswith(_ROWS):
        if name.endswith(f".{_HARMONICS}"):
            return (count, *bands, *like.shape[2:]) if bands and bands[0] in _BANDS else None
        return (count, *like.shape[1:])
    return like.shape
