"""The appearance of a trained scene in photographs: ``appearance.json`` and ``appearance.npz``.

The first has the embeddings of the training photographs by name, the second the colours of the
Gaussians, in the order of ``gaussians.npz``.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import RootModel

from pipeline.io.arrays import read_archive, write_arrays
from pipeline.io.bounded import opened_regular
from pipeline.runtime.json_file import JsonFile, mismatch
from pipeline.scene.appearance import Appearance

COLORS = "appearance.npz"


class Embeddings(JsonFile, RootModel[dict[str, tuple[float, ...]]]):
    """The appearance embedding of each training view by name, of mean 0."""

    file_name: ClassVar[str] = "appearance.json"


def write_appearance(folder: Path, appearance: Appearance) -> None:
    """Write the files into ``folder``."""
    named = {name: tuple(values.tolist()) for name, values in appearance.embeddings.items()}
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
    if not named or any(len(values) != size for values in named.values()):
        raise mismatch(folder / Embeddings.file_name, f"expected embeddings of {size} numbers each")
    return Appearance(colors, {name: np.array(values) for name, values in named.items()})
