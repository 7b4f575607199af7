"""Check that every photograph and the first frame of every video can be decoded, and that no
photograph is there twice."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from pipeline.io import exr
from pipeline.io.names import suffix_of
from pipeline.io.photofile import opened_image
from pipeline.io.recorded import read_recorded
from pipeline.io.tiff import is_tiff, without_orientation
from pipeline.io.videofile import FIX as FIX_VIDEO
from pipeline.io.videofile import opened_video
from pipeline.photos.duplicates import Signature, find_duplicates, signature
from pipeline.photos.verify_masks import verify_masks
from pipeline.runtime.errors import ChangedFileError, UserError
from pipeline.runtime.machine import threads_within
from pipeline.runtime.progress import track
from pipeline.scene.manifest import Manifest, Photo

# The peak memory in bytes per pixel of a photograph while it is decoded.
_PHOTO_BYTES = 7.0
# Smaller images are no photographs: reduced copies of them would have no pixels.
_MIN_SIDE = 4


def verify_manifest(
    manifest: Manifest, *, threads: int, min_photos: int, keep_duplicates: bool
) -> tuple[Manifest, list[str]]:
    """Apply ``verify_videos``, ``verify_photos`` and ``verify_masks`` in this order.

    Args:
        min_photos: The smallest number of photographs; 0 if there are videos, which add frames.
    """
    manifest, warnings = verify_videos(manifest)
    least = 0 if manifest.videos else min_photos
    manifest, left_out = verify_photos(
        manifest, threads=threads, min_photos=least, keep_duplicates=keep_duplicates
    )
    manifest, of_masks = verify_masks(manifest, threads=threads)
    return manifest, [*warnings, *left_out, *of_masks]


def verify_photos(
    manifest: Manifest, *, threads: int, min_photos: int = 1, keep_duplicates: bool = False
) -> tuple[Manifest, list[str]]:
    """Decode all photographs and remove damaged ones and duplicates from the manifest.

    Args:
        manifest: The photographs to decode.
        threads: The number of threads, which does not change the result.
        min_photos: The smallest number of photographs that can be decoded.
        keep_duplicates: Whether to keep photographs that show the same as others; copies of files
            are then a warning.

    Returns:
        The manifest without these photographs and with the new warnings, and these warnings: one
        for each damaged photograph, and one for all duplicates.

    Raises:
        UserError: Fewer than ``min_photos`` remain (the message says why), or a photograph has
            changed since it was scanned.
    """
    largest = max((photo.width * photo.height for photo in manifest.photos), default=0)
    with ThreadPoolExecutor(threads_within(threads, _PHOTO_BYTES * largest)) as pool:
        results = pool.map(_check, manifest.photos)
        found = list(track(results, "checking photographs", len(manifest.photos), "photos"))
    checked = dict(zip((photo.name for photo in manifest.photos), found, strict=True))
    good = [photo for photo in manifest.photos if checked[photo.name].fault is None]
    warnings = [
        f"{name}: left out: {check.fault}" for name, check in checked.items() if check.fault
    ]
    if keep_duplicates:
        warnings += _copies(good)
    else:
        signatures = {photo.name: checked[photo.name].signature for photo in good}
        replaced = find_duplicates({n: s for n, s in signatures.items() if s is not None})
        good = [photo for photo in good if photo.name not in replaced]
        warnings += _duplicates(replaced)
    if len(good) < min_photos:
        raise UserError(
            f"only {len(good)} of {len(checked)} photographs can be used, at least "
            f"{min_photos} are needed" + "".join(f"\n  {line}" for line in warnings),
            file=Path(manifest.photos[0].path).parent if manifest.photos else None,
            fix="replace damaged files, add photographs from other positions, or lower "
            "inspect.min_images",
        )
    update = {"photos": tuple(good), "warnings": (*manifest.warnings, *warnings)}
    return manifest.model_copy(update=update), warnings


def verify_videos(manifest: Manifest) -> tuple[Manifest, list[str]]:
    """Decode the first frame of each video and remove the damaged videos from the manifest.

    Returns:
        The manifest without the damaged videos and with the new warnings, and these warnings.

    Raises:
        UserError: There are no photographs, and no video can be decoded.
    """
    good, warnings = [], []
    for video in manifest.videos:
        try:
            with opened_video(Path(video.path)) as capture:
                fault = None if capture.read()[0] else "no frame can be decoded"
        except UserError as error:
            fault = error.what
        if fault is None:
            good.append(video)
        else:
            warnings.append(f"{Path(video.path).name}: left out: {fault}")
    if manifest.videos and not good and not manifest.photos:
        raise UserError(
            f"none of the {len(manifest.videos)} videos can be decoded"
            + "".join(f"\n  {line}" for line in warnings),
            file=Path(manifest.videos[0].path).parent,
            fix=FIX_VIDEO,
        )
    update = {"videos": tuple(good), "warnings": (*manifest.warnings, *warnings)}
    return manifest.model_copy(update=update), warnings


def _copies(photos: Sequence[Photo]) -> list[str]:
    """A warning if files are identical."""
    first: dict[str, str] = {}
    pairs = [
        f"{photo.name} = {first[photo.digest]}"
        for photo in photos
        if first.setdefault(photo.digest, photo.name) != photo.name
    ]
    if not pairs:
        return []
    some = ", ".join(pairs[:3]) + (", ..." if len(pairs) > 3 else "")
    return [
        f"copies of other photographs: {len(pairs)} ({some}): a test view with a copy among the "
        "training views makes the metrics too good; remove the copies"
    ]


def _duplicates(replaced: Mapping[str, str]) -> list[str]:
    """A warning if photographs were left out."""
    if not replaced:
        return []
    pairs = [f"{name} = {kept}" for name, kept in replaced.items()]
    some = ", ".join(pairs[:3]) + (", ..." if len(pairs) > 3 else "")
    return [
        f"{len(pairs)} photographs are left out, because they show the same as others ({some}): "
        "copies, or a camera that stood still (experiments.inspect.keep_duplicates)"
    ]


@dataclass(frozen=True)
class _Check:
    """The reason why a photograph cannot be decoded, or its signature (None for RAW files)."""

    fault: str | None = None
    signature: Signature | None = None


def _check(photo: Photo) -> _Check:
    if min(photo.width, photo.height) < _MIN_SIDE:
        return _Check(
            f"it is {photo.width}x{photo.height} pixels, expected at least {_MIN_SIDE} a side"
        )
    try:
        return _Check(signature=_decode(photo))
    except (MemoryError, ChangedFileError):
        raise
    # PIL's decoders raise OSError, SyntaxError, ValueError, struct.error, zlib.error and others;
    # LibRaw has its own exceptions.
    except Exception as error:
        text = str(error).strip() or type(error).__name__
        return _Check(f"cannot be decoded ({text})")


def _decode(photo: Photo) -> Signature | None:
    content = read_recorded(photo.path, photo.digest)
    data = io.BytesIO(without_orientation(content) if is_tiff(content) else content)
    suffix = suffix_of(photo.path)
    if suffix in exr.EXR_SUFFIXES:
        exr.read_pixels(data)
        return None
    if photo.linear:
        import rawpy  # Imported only if the scene has RAW files.

        with rawpy.imread(data) as raw:
            raw.unpack()
        return None
    with opened_image(data, photo.path) as image:
        image.load()
        return signature(image)
