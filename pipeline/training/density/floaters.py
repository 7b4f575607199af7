"""Floaters: Gaussians that hang in the air before one camera or very few.

Specks right before a camera explain its photograph as well as what stands behind them, and no other
view contradicts: the cameras beside it look past them, and to those across the room they are dots.
From a place between the cameras they are clouds. Where the light changed between photographs, a few
neighbours agree on a fog before them instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render import Backend, RasterCamera, RasterOptions, make_backend
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.init import SH_C0
from pipeline.training.data.known_depths import KnownDepths

#: A view is taken to see nothing nearer than this share of the depth at which its nearest sparse
#: points stand: the quantile (a few are wrong) of at least so many. In bonsai what one view alone
#: sees lies at 0.13 to 0.27 of that depth, or beyond it; nothing between.
AIR, NEAREST, LEAST_POINTS = 0.5, 0.02, 20
#: Views before which a Gaussian hangs have this share of its weight in all views, and so many
#: pixels of it. They are the ones that see most of it, one in so many views; of fewer, one.
MOST, LEAST_WEIGHT = 0.5, 0.1
ONE_IN = 100
FAINT = -20.0  # an opacity's logit


def air_depths(known: Sequence[KnownDepths]) -> NDArray[np.float64]:
    """(V,) camera z, world unit, up to which each view is taken to see nothing; 0 where too few
    sparse points say so."""
    return np.array(
        [AIR * np.quantile(k.z, NEAREST) if len(k) >= LEAST_POINTS else 0.0 for k in known]
    )


def floaters(
    gaussians: Gaussians,
    cameras: Sequence[RasterCamera],
    air: NDArray[np.float64],
    options: RasterOptions,
    pixel: float = 1.0,
    backend: Backend | None = None,
) -> Tensor:
    """(N,) bool: most of its weight is in one view, or in a hundredth of them, and there it is
    nearer than ``air``.

    A Gaussian's weight in a view is the sum over pixels of alpha times transmittance: the gradient
    of the picture's sum by the Gaussian's colour.

    Args:
        cameras: of all training views; smaller pictures than they train on will do.
        air: (V,) camera z (``air_depths``).
        options: how training draws; harmonics and background have no part in weights.
        pixel: how many pixels of a view one of these pictures stands for.
        backend: that draws; None: the default.
    """
    backend = backend or make_backend()
    grey = gaussians.with_sh_degree(0)
    grey = replace(grey, sh=torch.zeros_like(grey.sh))
    options = replace(options, sh_degree=0, background=None)
    total = torch.zeros(len(grey))
    # The largest weights so far, and of each as much as hangs in the air.
    few = max(1, round(len(cameras) / ONE_IN))
    largest, aired = torch.zeros(few, len(grey)), torch.zeros(few, len(grey))
    for camera, depth in zip(cameras, air, strict=True):
        drawn = backend.forward(*grey.parameters(), camera, options)
        asked = torch.full((camera.height, camera.width, 3), pixel / SH_C0)
        weight = backend.backward(drawn, asked, means2d_abs=False).sh[:, 0, 0]
        total += weight
        x, y, z, shift = camera.world_to_camera[2].to(torch.float32).tolist()
        # Not a product of matrices: BLAS may round by the number of threads.
        here = grey.means[:, 0] * x + grey.means[:, 1] * y + grey.means[:, 2] * z + shift
        hangs = torch.where(here < depth, weight, 0.0)
        # Insertion: what is smaller moves down a row, the smallest falls out.
        for row in range(few):
            more = weight > largest[row]
            weight, largest[row] = (
                torch.where(more, largest[row], weight),
                torch.where(more, weight, largest[row]),
            )
            hangs, aired[row] = (
                torch.where(more, aired[row], hangs),
                torch.where(more, hangs, aired[row]),
            )
    found = aired.sum(0)
    return (found > LEAST_WEIGHT) & (found > MOST * total)


def fade_floaters(
    gaussians: Gaussians,
    cameras: Sequence[RasterCamera],
    air: NDArray[np.float64],
    options: RasterOptions,
    pixel: float,
    backend: Backend,
) -> int:
    """Make floaters too faint for density control to keep, in place; how many. See ``floaters``."""
    found = floaters(gaussians, cameras, air, options, pixel, backend)
    gaussians.opacity_logits[found] = FAINT
    return int(found.sum())
