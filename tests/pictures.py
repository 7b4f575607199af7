"""Small photographs made for tests of the scene room."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image


def picture(
    path: Path,
    size: tuple[int, int] = (64, 48),
    *,
    mode: str = "RGB",
    exif: Mapping[int, Any] | None = None,
    gps: Mapping[int, Any] | None = None,
    tags: Mapping[int, Any] | None = None,
) -> Path:
    """Write noise of ``size`` (width, height); the name is the seed, so no two are alike.

    ``tags`` go to the base folder of EXIF, ``exif`` and ``gps`` to theirs.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(list(path.name.encode()))
    channels = {"RGB": 3, "RGBA": 4, "L": 1}[mode]
    values = rng.integers(0, 256, (size[1], size[0], channels), dtype=np.uint8)
    image = Image.fromarray(values if channels > 1 else values[..., 0], mode)
    block = Image.Exif()
    for tag, value in (tags or {}).items():
        block[tag] = value
    if exif:
        block.get_ifd(0x8769).update(exif)
    if gps:
        block.get_ifd(0x8825).update(gps)
    image.save(path, exif=block)
    return path


def photos(folder: Path, count: int, size: tuple[int, int] = (64, 48), **kwargs: Any) -> list[Path]:
    """p00.jpg, p01.jpg, ... in ``folder``."""
    return [picture(folder / f"p{i:02d}.jpg", size, **kwargs) for i in range(count)]
