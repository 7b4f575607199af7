"""``frame.json``: what files of Gaussians leave open: axes, unit, up, and how to render them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.scene.views import View, scene_extent
from pipeline.splats.gaussians import Gaussians

AXES = (
    "right-handed; the world of the cameras as COLMAP has it: a camera at the identity has x to "
    "the right and y down in its picture, and looks along z"
)
UNIT = "that of the camera poses, as they were given"
OTHER_AXES = {
    "point_cloud.glb": "turned by 180 degrees about z (x and y negated): glTF is y up",
    "transforms.json": "this world; the cameras' own axes are OpenGL's (x right, y up, z backward)",
}


def describe_frame(
    gaussians: Gaussians,
    views: Sequence[View],
    up: NDArray[np.float64],
    render: dict[str, Any],
    files: Sequence[str],
    georeference: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The content of ``frame.json``.

    Args:
        views: all cameras of the scene.
        up: (3,) in the world.
        render: background (RGB in [0, 1]), near plane (world unit), antialias: those that the
            Gaussians are to be rendered with.
        files: names of the exported files; those with other axes are named with them.
        georeference: the content of the reconstruction's ``georeference.json``, None where the
            poses were given.
    """
    placed = georeference or {}
    centres = np.stack([view.centre for view in views])
    return {
        "axes": f"{AXES}; {placed['axes']}" if placed else AXES,
        "axes_of": {name: OTHER_AXES[name] for name in files if name in OTHER_AXES},
        "up": np.round(up, 6).tolist(),
        "unit": placed.get("unit", UNIT),
        "georeference": {k: placed[k] for k in ("method", "origin", "projection") if k in placed},
        "cameras": {
            "count": len(views),
            "centre": [_digits(value) for value in centres.mean(0)],
            "extent": _digits(scene_extent(list(views))),
        },
        "gaussians": {"count": len(gaussians), "sh_degree": gaussians.sh_degree},
        "colour": "display-ready sRGB: 0.5 + spherical harmonics, blended as it is",
        "render": render,
    }


def _digits(value: float) -> float:
    """Seven significant ones: a unit may be of any size."""
    return float(f"{value:.7g}")
