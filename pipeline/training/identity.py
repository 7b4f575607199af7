"""Which run a checkpoint is of."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.config.schema import Train
from pipeline.scene.model import View
from pipeline.splats.gaussians import Gaussians
from pipeline.training.depth import KnownDepths

# Raise it when the state of a training or its meaning changes.
STATE_VERSION = 10


def identity_of(
    views: Sequence[View],
    initial: Gaussians,
    config: Train,
    seed: int,
    sizes: tuple[float, float],
    gains: NDArray[np.float64] | None,
    depths: Sequence[KnownDepths] | None,
) -> str:
    """A digest of all that determines the result, apart from the pixels (whose stage's key names
    the folder of checkpoints).

    Args:
        sizes: the extent and the scale (``trainer.train``).
    """
    digest = hashlib.sha256()
    described = [
        (v.name, v.width, v.height, v.fx, v.fy, v.cx, v.cy, v.world_to_camera.tolist(), v.mask)
        for v in views
    ]
    exposures = None if gains is None else gains.tolist()
    text = json.dumps([STATE_VERSION, config.model_dump(), seed, sizes, described, exposures])
    digest.update(text.encode())
    arrays: list[NDArray[Any]] = list(initial.arrays().values())
    for known in depths or ():
        arrays += [known.xy, known.z, known.weight]
    for array in arrays:
        digest.update(array.tobytes())
    return digest.hexdigest()
