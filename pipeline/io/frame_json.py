"""``frame.json``: axes, unit, up direction and render settings of exported Gaussians, which their
file formats do not store."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.scene.views import View, scene_extent
from pipeline.splats.gaussians import Gaussians

AXES = (
    "right-handed, COLMAP's convention: in a camera at the identity, x is right, y is down and z "
    "is forward"
)
UNIT = "that of the given camera poses"
OTHER_AXES = {
    "point_cloud.glb": "rotated by 180 degrees about z (x and y negated), because glTF is y up",
    "transforms.json": "the same world; camera axes are OpenGL's (x right, y up, z backward)",
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
        views: all views of the scene.
        up: (3,) up direction in the world.
        render: the settings that the Gaussians must be rendered with: background (RGB in
            [0, 1]), near plane (world units), antialias.
        files: names of the exported files.
        georeference: the content of ``georeference.json``, None if there is none.
    """
    world = georeference or {}
    centres = np.stack([view.centre for view in views])
    return {
        "axes": f"{AXES}; {world['axes']}" if world else AXES,
        "axes_of": {name: OTHER_AXES[name] for name in files if name in OTHER_AXES},
        "up": np.round(up, 6).tolist(),
        "unit": world.get("unit", UNIT),
        "georeference": {k: world[k] for k in ("method", "origin", "projection") if k in world},
        "cameras": {
            "count": len(views),
            "centre": [_rounded(value) for value in centres.mean(0)],
            "extent": _rounded(scene_extent(list(views))),
        },
        "gaussians": {"count": len(gaussians), "sh_degree": gaussians.sh_degree},
        "colour": "sRGB: 0.5 + spherical harmonics, blended without conversion to linear",
        "render": render,
    }


def _rounded(value: float) -> float:
    """Seven significant digits."""
    return float(f"{value:.7g}")
