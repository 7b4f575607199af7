"""Checkpoints of training, and the identity of the run that they belong to.

A file is a numpy archive followed by the 32 bytes of its SHA-256; a damaged file is not used. It is
written under a temporary name, synced and renamed. The last two are kept.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeline.training.data.inputs import Inputs
from pipeline.training.run import TrainingRun

KEPT = 2
PATTERN = "checkpoint_*.npz.sha256"
# Increment when the contents of checkpoints or their meaning change.
STATE_VERSION = 22


@dataclass
class Checkpoint:
    """The whole state of a run.

    Attributes:
        step: The number of steps done.
        identity: The digest of the run's inputs and options.
        arrays: The arrays by name.
        values: The rest of the state, as JSON.
    """

    step: int
    identity: str
    arrays: dict[str, NDArray[Any]]
    values: dict[str, Any]


def identity_of(inputs: Inputs, run: TrainingRun) -> str:
    """Digest of everything that determines the result but the pixels, which the key of the stage
    (in the name of the folder of checkpoints) covers."""
    digest = hashlib.sha256()
    views = [
        (v.name, v.width, v.height, v.fx, v.fy, v.cx, v.cy, v.world_to_camera.tolist(), v.mask)
        for v in inputs.views
    ]
    sizes = (inputs.extent, inputs.size, inputs.seen_share)
    light = None if inputs.light is None else [of.model_dump() for of in inputs.light]
    embeddings = None if inputs.embeddings is None else inputs.embeddings.tolist()
    empty = None if inputs.empty_depths is None else inputs.empty_depths.tolist()
    # Another device can continue: the log says so.
    options = run.options.model_dump(exclude={"device"})
    text = json.dumps([STATE_VERSION, options, run.seed, sizes, views, light, embeddings, empty])
    digest.update(text.encode())
    arrays: list[NDArray[Any]] = list(inputs.initial.arrays().values())
    for known in inputs.depths or ():
        arrays += [known.xy, known.z, known.weight]
    for array in arrays:
        digest.update(array.tobytes())
    return digest.hexdigest()


class _HashingWriter(io.RawIOBase):
    """Writes and hashes bytes; not seekable, so that each byte is written once."""

    def __init__(self, file: BinaryIO):
        self.file, self.hash = file, hashlib.sha256()

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self.hash.update(data)
        return self.file.write(data)


def save(folder: Path, checkpoint: Checkpoint) -> Path:
    """Write a checkpoint into ``folder`` and delete all but the last ``KEPT``."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"checkpoint_{checkpoint.step:08d}.npz.sha256"
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    header = {
        "step": checkpoint.step,
        "identity": checkpoint.identity,
        "values": checkpoint.values,
    }
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    try:
        with open(temporary, "wb") as file:
            writer = _HashingWriter(file)
            np.savez(writer, **checkpoint.arrays, __header__=text)  # type: ignore[arg-type]
            file.write(writer.hash.digest())
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    for old in sorted(folder.glob(PATTERN))[:-KEPT]:
        old.unlink(missing_ok=True)
    return path


def load_latest(
    folder: Path, identity: str, on_warning: Callable[[str], None]
) -> Checkpoint | None:
    """The newest intact checkpoint of this run, or None. Damaged ones and those of other runs are
    skipped with a warning."""
    for path in sorted(folder.glob(PATTERN), reverse=True):
        checkpoint = _load(path)
        if checkpoint is None:
            on_warning(f"{path}: the checkpoint is damaged and not used")
        elif checkpoint.identity != identity:
            on_warning(
                f"{path}: the checkpoint belongs to a run with other inputs or options; not used"
            )
        else:
            return checkpoint
    return None


def newest(folder: Path) -> Checkpoint | None:
    """The newest intact checkpoint of any run, for display; None if there is none."""
    found = map(_load, sorted(folder.glob(PATTERN), reverse=True))
    return next((checkpoint for checkpoint in found if checkpoint is not None), None)


def _load(path: Path) -> Checkpoint | None:
    try:
        data = path.read_bytes()
    except OSError:
        return None
    payload, digest = memoryview(data)[:-32], data[-32:]
    if len(data) < 32 or hashlib.sha256(payload).digest() != digest:
        return None
    # A right digest of a file that another program wrote: numpy raises exceptions of many types.
    try:
        with np.load(io.BytesIO(payload)) as archive:
            arrays = {name: archive[name] for name in archive.files}
        header = json.loads(arrays.pop("__header__").tobytes())
        step, identity, values = (header[name] for name in ("step", "identity", "values"))
    except Exception:
        return None
    if not (type(step) is int and step >= 0 and isinstance(identity, str)):
        return None
    return Checkpoint(step, identity, arrays, values) if isinstance(values, dict) else None


def other_build(values: Mapping[str, Any], build: Mapping[str, str]) -> str | None:
    """A line for the log if a checkpoint was made with another build. It is used: results are
    equal to the last bit only with one build, but of the same quality with any."""
    before = values.get("built")
    facts = "{instruction_set} ({compiler})"
    if not isinstance(before, dict) or before == build or not before.keys() >= build.keys():
        return None
    return (
        f"training continues with {facts.format(**build)} from a checkpoint made with "
        f"{facts.format(**before)}: the last bits of the result are those of neither alone"
    )
