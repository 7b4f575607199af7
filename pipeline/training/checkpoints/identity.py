"""Which run a checkpoint is of."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from numpy.typing import NDArray

from pipeline.config.schema import Train
from pipeline.training.data.inputs import Inputs

# Raise it when the state of a training or its meaning changes.
STATE_VERSION = 15


def identity_of(inputs: Inputs, config: Train, seed: int) -> str:
    """A digest of all that determines the result, apart from the pixels (whose stage's key names
    the folder of checkpoints)."""
    digest = hashlib.sha256()
    views = [
        (v.name, v.width, v.height, v.fx, v.fy, v.cx, v.cy, v.world_to_camera.tolist(), v.mask)
        for v in inputs.views
    ]
    sizes = (inputs.extent, inputs.size)
    gains = None if inputs.gains is None else inputs.gains.tolist()
    air = None if inputs.air is None else inputs.air.tolist()
    text = json.dumps([STATE_VERSION, config.model_dump(), seed, sizes, views, gains, air])
    digest.update(text.encode())
    arrays: list[NDArray[Any]] = list(inputs.initial.arrays().values())
    for known in inputs.depths or ():
        arrays += [known.xy, known.z, known.weight]
    for array in arrays:
        digest.update(array.tobytes())
    return digest.hexdigest()
