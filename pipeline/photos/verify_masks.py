"""Check that masks can be decoded and that they exclude something, but not everything."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from pipeline.photos.load import read_mask
from pipeline.runtime.errors import UserError
from pipeline.runtime.machine import threads_within
from pipeline.runtime.progress import track
from pipeline.scene.manifest import Manifest, Photo

# The peak memory in bytes per pixel of a mask while it is decoded.
_MASK_BYTES = 12.0
_FIX = (
    "black and transparent pixels are excluded: invert the masks if white is what they exclude, "
    "or use whole photographs with views.masks: ignore"
)


@dataclass(frozen=True)
class _Found:
    """The pixels that one mask keeps.

    Attributes:
        file: The path of the mask.
        kept: The share of the pixels that it keeps.
        darkest: The field of the same name of ``masks.MaskPixels``.
    """

    file: Path
    kept: float
    darkest: int | None


def verify_masks(manifest: Manifest, *, threads: int) -> tuple[Manifest, list[str]]:
    """Decode all masks.

    Args:
        threads: The number of threads. It does not change the result.

    Returns:
        The manifest with the new warnings, and these warnings: one for masks that exclude nothing,
        one for masks that exclude everything, and one for masks without a bright pixel.

    Raises:
        UserError: A mask cannot be decoded, or all photographs have masks that exclude everything.
    """
    masked = [photo for photo in manifest.photos if photo.mask is not None]
    if not masked:
        return manifest, []
    largest = max(photo.width * photo.height for photo in masked)
    with ThreadPoolExecutor(threads_within(threads, _MASK_BYTES * largest)) as pool:
        found = list(track(pool.map(_read, masked), "checking masks", len(masked), "masks"))
    hidden = [mask for mask in found if mask.kept == 0]
    if len(hidden) == len(manifest.photos):
        raise UserError(
            f"all {len(hidden)} masks exclude every pixel of their photographs "
            f"(first: {hidden[0].file.name})",
            file=hidden[0].file.parent,
            fix=_FIX,
        )
    warnings = _warnings(found, hidden)
    update = {"warnings": (*manifest.warnings, *warnings)}
    return manifest.model_copy(update=update), warnings


def _read(photo: Photo) -> _Found:
    assert photo.mask is not None
    pixels = read_mask(photo.mask, photo.mask_digest)
    return _Found(Path(photo.mask), float(pixels.valid.mean()), pixels.darkest)


def _warnings(found: Sequence[_Found], hidden: Sequence[_Found]) -> list[str]:
    warnings = []
    of = f"of {len(found)} masks"
    if whole := [mask for mask in found if mask.kept == 1]:
        warnings.append(f"{len(whole)} {of} exclude no pixel (first: {whole[0].file.name})")
    if hidden:
        warnings.append(
            f"{len(hidden)} {of} exclude every pixel of their photographs, which are not used "
            f"(first: {hidden[0].file.name}): {_FIX}"
        )
    if dark := [mask for mask in found if mask.darkest is not None]:
        warnings.append(
            f"{len(dark)} {of} have no value of half of the range; every value but 0 counts as "
            f"valid there (first: {dark[0].file.name}, largest value {dark[0].darkest})"
        )
    return warnings
