"""The identity of a run, by which its checkpoints are recognised."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from numpy.typing import NDArray

from pipeline.training.data.inputs import Inputs
from pipeline.training.run import TrainingRun

# Increment when the contents of checkpoints or their meaning change.
STATE_VERSION = 20


def identity_of(inputs: Inputs, run: TrainingRun) -> str:
    """Digest of everything that determines the result but the pixels, which the key of the stage
    (in the name of the folder of checkpoints) covers."""
    digest = hashlib.sha256()
    views = [
        (v.name, v.width, v.height, v.fx, v.fy, v.cx, v.cy, v.world_to_camera.tolist(), v.mask)
        for v in inputs.views
    ]
    sizes = (inputs.extent, inputs.size, inputs.seen_share)
    gains = None if inputs.gains is None else inputs.gains.tolist()
    embeddings = None if inputs.embeddings is None else inputs.embeddings.tolist()
    empty = None if inputs.empty_depths is None else inputs.empty_depths.tolist()
    # Another device can continue: the log says so.
    options = run.options.model_dump(exclude={"device"})
    text = json.dumps([STATE_VERSION, options, run.seed, sizes, views, gains, embeddings, empty])
    digest.update(text.encode())
    arrays: list[NDArray[Any]] = list(inputs.initial.arrays().values())
    for known in inputs.depths or ():
        arrays += [known.xy, known.z, known.weight]
    for array in arrays:
        digest.update(array.tobytes())
    return digest.hexdigest()
