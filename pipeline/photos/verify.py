"""Check that every photograph and the first frame of every video can be decoded."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from PIL import Image

from pipeline.io import heif
from pipeline.io.names import suffix_of
from pipeline.io.recorded import ChangedFileError, read_recorded
from pipeline.io.videofile import FIX as FIX_VIDEO
from pipeline.io.videofile import opened_video
from pipeline.runtime.errors import UserError
from pipeline.runtime.progress import track
from pipeline.scene.manifest import Manifest, Photo


def verify_manifest(
    manifest: Manifest, *, threads: int, min_photos: int
) -> tuple[Manifest, list[str]]:
    """``verify_videos``, then ``verify_photos``.

    Args:
        min_photos: smallest number of photographs; 0 if there are videos, which add frames.
    """
    manifest, warnings = verify_videos(manifest)
    least = 0 if manifest.videos else min_photos
    manifest, damaged = verify_photos(manifest, threads=threads, min_photos=least)
    return manifest, [*warnings, *damaged]


def verify_photos(
    manifest: Manifest, *, threads: int, min_photos: int = 1
) -> tuple[Manifest, list[str]]:
    """Decode all photographs and remove the damaged ones from the manifest.

    Args:
        manifest: the photographs to decode.
        threads: number of threads; does not change the result.
        min_photos: smallest number of photographs that can be decoded.

    Returns:
        The manifest without the damaged photographs and with the new warnings, and these warnings:
        one for each damaged photograph, and one if photographs are copies of others.

    Raises:
        UserError: fewer than ``min_photos`` can be decoded (the message names the damaged ones), or
            a photograph has changed since it was scanned.
    """
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        results = pool.map(_fault_of, manifest.photos)
        faults = list(track(results, "checking photographs", len(manifest.photos), "photos"))
    good = tuple(
        photo for photo, fault in zip(manifest.photos, faults, strict=True) if fault is None
    )
    warnings = [
        f"{photo.name}: left out: {fault}"
        for photo, fault in zip(manifest.photos, faults, strict=True)
        if fault is not None
    ]
    if len(good) < min_photos:
        raise UserError(
            f"only {len(good)} of {len(faults)} photographs can be decoded, at least "
            f"{min_photos} are needed" + "".join(f"\n  {line}" for line in warnings),
            file=Path(manifest.photos[0].path).parent if manifest.photos else None,
            fix="replace the damaged files, or lower inspect.min_images",
        )
    warnings += _copies(good)
    update = {"photos": good, "warnings": (*manifest.warnings, *warnings)}
    return manifest.model_copy(update=update), warnings


def verify_videos(manifest: Manifest) -> tuple[Manifest, list[str]]:
    """Decode the first frame of each video and remove the damaged videos from the manifest.

    Returns:
        The manifest without the damaged videos and with the new warnings, and these warnings.

    Raises:
        UserError: there are no photographs, and no video can be decoded.
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


def _fault_of(photo: Photo) -> str | None:
    """Why the photograph cannot be decoded; None if it can."""
    decode: Callable[[Photo], None] = _decode_raw if photo.raw else _decode
    try:
        decode(photo)
    except (MemoryError, ChangedFileError):
        raise
    # PIL's decoders raise OSError, SyntaxError, ValueError, struct.error, zlib.error and others;
    # LibRaw has its own exceptions.
    except Exception as error:
        text = str(error).strip() or type(error).__name__
        return f"cannot be decoded ({text})"
    return None


def _decode(photo: Photo) -> None:
    if suffix_of(photo.path) in heif.HEIF_SUFFIXES:
        heif.register()
    with Image.open(io.BytesIO(read_recorded(photo.path, photo.digest))) as image:
        image.load()


def _decode_raw(photo: Photo) -> None:
    import rawpy  # Imported only if the scene has RAW files.

    with rawpy.imread(io.BytesIO(read_recorded(photo.path, photo.digest))) as raw:
        raw.unpack()
