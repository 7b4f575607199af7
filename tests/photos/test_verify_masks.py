"""What masks exclude is said where it happens: in the inspect stage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.config.schema import Config
from pipeline.photos.verify import verify_manifest
from pipeline.plan.scan import scan
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest
from tests.pictures import photos


def scene(folder: Path, masks: list[np.ndarray | None]) -> Manifest:
    photos(folder / "images", len(masks))
    (folder / "masks").mkdir()
    for number, mask in enumerate(masks):
        if mask is not None:
            Image.fromarray(mask).save(folder / "masks" / f"p{number:02d}.png")
    return scan(folder, "s", Config(), cache=None).manifest


def checked(manifest: Manifest) -> list[str]:
    result, warnings = verify_manifest(manifest, threads=1, min_photos=2, keep_duplicates=True)
    assert set(warnings) <= set(result.warnings)
    return warnings


BLACK, WHITE = np.zeros((48, 64), np.uint8), np.full((48, 64), 255, np.uint8)
HALF = np.vstack([BLACK[:24], WHITE[:24]])


def test_usual_masks_need_no_word(tmp_path: Path) -> None:
    assert checked(scene(tmp_path, [HALF, HALF, None])) == []


def test_black_white_and_dark_masks_are_counted(tmp_path: Path) -> None:
    found = checked(scene(tmp_path, [BLACK, WHITE, WHITE, HALF, HALF // 85]))
    nothing, everything, dark = found
    assert "2 of 5 masks exclude no pixel (first: p01.png)" in nothing
    assert "1 of 5" in everything and "p00.png" in everything and "views.masks" in everything
    assert "p04.png, largest value 3" in dark


@pytest.mark.parametrize("mask", [BLACK, np.dstack([WHITE] * 3 + [BLACK])], ids=["black", "alpha"])
def test_masks_that_exclude_everything_are_an_error(tmp_path: Path, mask: np.ndarray) -> None:
    with pytest.raises(UserError, match="all 3 masks exclude every pixel") as error:
        checked(scene(tmp_path, [mask] * 3))
    assert "invert" in str(error.value) and "masks" in str(error.value.file)


def test_a_damaged_mask_ends_the_first_stage(tmp_path: Path) -> None:
    manifest = scene(tmp_path, [HALF] * 3)
    file = tmp_path / "masks" / "p01.png"
    data = bytearray(file.read_bytes())
    data[-30] ^= 1
    file.write_bytes(data)
    manifest = scan(tmp_path, "s", Config(), cache=None).manifest
    with pytest.raises(UserError, match=r"p01\.png"):
        checked(manifest)
