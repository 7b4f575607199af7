"""The appearance of a trained scene in photographs: ``appearance.json`` and ``appearance.npz``.

The first has the embeddings and the gains of the training photographs by name, the second the
colours of the Gaussians, in the order of ``gaussians.npz``.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, RootModel

from pipeline.io.arrays import read_archive, write_arrays
from pipeline.io.bounded import opened_regular
from pipeline.runtime.json_file import JsonFile, Vector3, mismatch
from pipeline.scene.appearance import Appearance

COLORS = "appearance.npz"


class PhotographAppearance(BaseModel):
    """The appearance of a photograph."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    embedding: tuple[float, ...]
    """The appearance embedding; the mean over the photographs is 0."""
    gain: Vector3 | None
    """Factors of the colours by exposure and white balance; null if there are none."""


class Embeddings(JsonFile, RootModel[dict[str, PhotographAppearance]]):
    """The appearance of each training view by name."""

    file_name: ClassVar[str] = "appearance.json"


def write_appearance(folder: Path, appearance: Appearance) -> None:
    """Write the files into ``folder``."""
    named = {}
    for name, values in appearance.embeddings.items():
        gain = appearance.gains[name].tolist() if appearance.gains else None
        named[name] = PhotographAppearance(embedding=tuple(values.tolist()), gain=gain)
    Embeddings(named).write(folder)
    write_arrays(folder / COLORS, {"colors": appearance.colors})


def read_appearance(folder: Path, gaussians: int) -> Appearance | None:
    """Read the files of a stage's folder; None if it has none.

    Args:
        gaussians: The number of Gaussians of the scene.

    Raises:
        UserError: a file is damaged, or the files are of different scenes.
    """
    if not (folder / Embeddings.file_name).is_file():
        return None
    named = Embeddings.read(folder).root
    file = folder / COLORS
    try:
        with opened_regular(file) as opened:
            colors = np.asarray(read_archive(opened)["colors"], np.float32)
    except (OSError, ValueError, KeyError) as error:
        raise mismatch(file, f"expected the appearance of Gaussians: {error}") from None
    size = colors.shape[1] if colors.ndim == 3 else 0
    if colors.shape != (gaussians, size, 3):
        raise mismatch(
            file, f"expected colours of {gaussians} Gaussians, found an array {colors.shape}"
        )
    if not named or any(len(found.embedding) != size for found in named.values()):
        raise mismatch(folder / Embeddings.file_name, f"expected embeddings of {size} numbers each")
    gains = {name: found.gain for name, found in named.items() if found.gain is not None}
    if gains and len(gains) < len(named):
        raise mismatch(folder / Embeddings.file_name, "expected gains of all views or of none")
    return Appearance(
        colors,
        {name: np.array(found.embedding) for name, found in named.items()},
        {name: np.array(gain) for name, gain in gains.items()},
    )
