"""Development of RAW and EXR files with the same settings for all photographs of a scene."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.config.schema import Decode
from pipeline.io.exr import EXR_SUFFIXES
from pipeline.io.names import suffix_of
from pipeline.io.recorded import digest_of
from pipeline.photos.encode import write_picture
from pipeline.photos.linear_image import Developed, develop_exr
from pipeline.photos.naming import rename
from pipeline.photos.raw import RawDeveloper
from pipeline.runtime.errors import UserError
from pipeline.runtime.progress import track
from pipeline.scene.manifest import Manifest, Photo

FIX = "Copy the file again from the camera or program that wrote it, or remove it from the folder."


@dataclass(frozen=True)
class DecodeReport:
    """The manifest with developed photographs, and a warning for each file left out."""

    manifest: Manifest
    warnings: tuple[str, ...]


def develop(manifest: Manifest, config: Decode, out: Path, *, threads: int) -> DecodeReport:
    """Develop the RAW and EXR files of ``manifest`` to ``out/images/<stem>.png`` and
    ``out/images.json``.

    The PNGs are 8-bit sRGB, or 16-bit linear light with sRGB primaries (``config.linear``). All
    photographs have the same exposure; photographs of one camera body have the same white balance.
    EXIF orientation is not applied. The new manifest has the sizes and focal lengths of the PNGs.
    Other photographs are unchanged.

    Raises:
        UserError: None of the files could be read.
    """
    linear = [photo for photo in manifest.photos if photo.linear]
    names = rename({photo.name: ".png" if photo.linear else "" for photo in manifest.photos})
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        raws = RawDeveloper([photo for photo in linear if not _is_exr(photo)], config, pool)

        def work(photo: Photo) -> Photo | str:
            try:
                developed = develop_exr(photo, config) if _is_exr(photo) else raws.develop(photo)
            except ValueError as error:
                return f"{photo.name}: left out, it cannot be read ({error})"
            return _write(photo, names[photo.name], developed, out)

        jobs = pool.map(work, linear)
        results = list(track(jobs, "developing", len(linear), "photographs"))
    warnings = [result for result in results if isinstance(result, str)]
    new = {
        photo.name: result
        for photo, result in zip(linear, results, strict=True)
        if isinstance(result, Photo)
    }
    if linear and not new:
        raise UserError(
            f"none of the {len(linear)} RAW and EXR files could be read"
            + "".join(f"\n  {line}" for line in warnings[:3]),
            file=Path(linear[0].path).parent,
            fix=FIX,
        )
    photos = [
        new[photo.name] if photo.linear else photo
        for photo in manifest.photos
        if not photo.linear or photo.name in new
    ]
    developed = manifest.model_copy(
        update={
            "photos": tuple(sorted(photos, key=lambda photo: photo.name)),
            "warnings": (*manifest.warnings, *warnings),
        }
    )
    developed.write(out / "images.json")
    return DecodeReport(developed, tuple(warnings))


def _is_exr(photo: Photo) -> bool:
    return suffix_of(photo.path) in EXR_SUFFIXES


def _write(photo: Photo, name: str, developed: Developed, out: Path) -> Photo:
    rgb, alpha = developed.rgb, developed.alpha
    path = out / "images" / name
    write_picture(path, rgb[..., ::-1] if alpha is None else np.dstack([rgb[..., ::-1], alpha]))
    height, width = rgb.shape[:2]
    focal = None if photo.focal_px is None else photo.focal_px * width / photo.width
    return photo.model_copy(
        update={
            "name": name,
            "path": str(path),
            "width": width,
            "height": height,
            "digest": digest_of(path),
            "linear": False,
            "alpha": alpha is not None,
            "colours": "",
            "bits": 8 * rgb.itemsize,
            "focal_px": focal,
        }
    )
