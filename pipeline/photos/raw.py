"""Development of RAW files with the same settings for all photographs of a scene.

LibRaw's defaults choose brightness and white balance for each image, which makes the photographs of
a scene inconsistent. Here all photographs share the exposure, and photographs of one camera body
share the white balance.
"""

from __future__ import annotations

import io
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rawpy
from numpy.typing import NDArray

from pipeline.config.schema import Decode
from pipeline.io.recorded import digest_of, read_recorded
from pipeline.photos.naming import rename
from pipeline.runtime.errors import UserError
from pipeline.runtime.progress import track
from pipeline.scene.manifest import Manifest, Photo

DEMOSAIC = {
    "linear": rawpy.DemosaicAlgorithm.LINEAR,
    "ahd": rawpy.DemosaicAlgorithm.AHD,
    "aahd": rawpy.DemosaicAlgorithm.AAHD,
}
SRGB_GAMMA = (2.4, 12.92)  # LibRaw's default is the curve of BT.709.
FIX = "Copy the file from the camera again, or remove it from the folder."


@dataclass(frozen=True)
class DecodeReport:
    """The manifest with developed photographs, and a warning for each RAW file left out."""

    manifest: Manifest
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _Balance:
    """White balances of a RAW file.

    Attributes:
        body: identifies the camera body (its colour matrix).
        as_shot, daylight: (4,) float64 factors relative to green; ``as_shot`` is None if the file
            has none.
    """

    body: bytes
    as_shot: NDArray[np.float64] | None
    daylight: NDArray[np.float64]


def develop(manifest: Manifest, config: Decode, out: Path, *, threads: int) -> DecodeReport:
    """Develop the RAW files of ``manifest`` to ``out/images/<stem>.png`` and ``out/images.json``.

    The PNGs are 8-bit sRGB, or 16-bit linear light with sRGB primaries (``config.linear``). All
    photographs have the same exposure; photographs of one camera body have the same white balance.
    EXIF orientation is not applied. The new manifest has the sizes and focal lengths of the PNGs.
    Other photographs are unchanged.

    Raises:
        UserError: none of the RAW files could be read.
    """
    raws = [photo for photo in manifest.photos if photo.raw]
    names = rename({photo.name: ".png" if photo.raw else "" for photo in manifest.photos})
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        balances = dict(zip(raws, pool.map(_balance, raws), strict=True))
        warnings = [balance for balance in balances.values() if isinstance(balance, str)]
        readable = {photo: b for photo, b in balances.items() if isinstance(b, _Balance)}
        common = _common_balance(list(readable.values()), config)

        def work(photo: Photo) -> Photo | str:
            return _develop_one(photo, names[photo.name], common[readable[photo].body], config, out)

        jobs = pool.map(work, readable)
        results = dict(
            zip(readable, track(jobs, "developing RAW", len(readable), "photographs"), strict=True)
        )
    warnings += [result for result in results.values() if isinstance(result, str)]
    new = {photo.name: result for photo, result in results.items() if isinstance(result, Photo)}
    if raws and not new:
        raise UserError(
            f"none of the {len(raws)} RAW files could be read",
            file=Path(raws[0].path).parent,
            fix=FIX,
        )
    photos = [
        new[photo.name] if photo.raw else photo
        for photo in manifest.photos
        if not photo.raw or photo.name in new
    ]
    developed = manifest.model_copy(
        update={
            "photos": tuple(sorted(photos, key=lambda photo: photo.name)),
            "warnings": (*manifest.warnings, *warnings),
        }
    )
    developed.write(out / "images.json")
    return DecodeReport(developed, tuple(warnings))


def _balance(photo: Photo) -> _Balance | str:
    """White balances of a RAW file, or a warning if it cannot be read."""
    try:
        with rawpy.imread(_bytes_of(photo)) as raw:
            body = np.asarray(raw.rgb_xyz_matrix).tobytes()
            as_shot = np.array(raw.camera_whitebalance, np.float64)
            daylight = np.array(raw.daylight_whitebalance, np.float64)
    except rawpy.LibRawError as error:
        return _left_out(photo, error)
    known = np.all(np.isfinite(as_shot[:3])) and np.all(as_shot[:3] > 0)
    if not np.all(daylight[:3] > 0):
        daylight = np.array([1.0, 1.0, 1.0, 0.0])
    return _Balance(body, as_shot / as_shot[1] if known else None, daylight / daylight[1])


def _common_balance(balances: list[_Balance], config: Decode) -> dict[bytes, list[float]]:
    """One white balance for each camera body: the median as-shot balance, or daylight if the files
    have none or ``config`` selects it."""
    result = {}
    for body in {balance.body for balance in balances}:
        same = [balance for balance in balances if balance.body == body]
        as_shot = [balance.as_shot for balance in same if balance.as_shot is not None]
        chosen = as_shot if config.white_balance == "camera" and as_shot else None
        values = np.median(chosen or [balance.daylight for balance in same], axis=0)
        result[body] = [float(v) for v in values]
    return result


def _develop_one(
    photo: Photo, name: str, balance: list[float], config: Decode, out: Path
) -> Photo | str:
    """The developed photograph, or a warning if it cannot be read."""
    try:
        with rawpy.imread(_bytes_of(photo)) as raw:
            rgb = raw.postprocess(
                demosaic_algorithm=DEMOSAIC[config.demosaic],
                half_size=config.half_size,
                user_wb=balance,
                no_auto_bright=True,
                adjust_maximum_thr=0.0,
                user_flip=0,
                gamma=(1, 1) if config.linear else SRGB_GAMMA,
                output_bps=16 if config.linear else 8,
                output_color=rawpy.ColorSpace.sRGB,
            )
    except rawpy.LibRawError as error:
        return _left_out(photo, error)
    path = out / "images" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    # Encoded and written separately: cv2.imwrite does not report a full disk.
    _, data = cv2.imencode(".png", rgb[..., ::-1])
    path.write_bytes(data.tobytes())
    height, width = rgb.shape[:2]
    focal = None if photo.focal_px is None else photo.focal_px * width / photo.width
    return photo.model_copy(
        update={
            "name": name,
            "path": str(path),
            "width": width,
            "height": height,
            "digest": digest_of(path),
            "raw": False,
            "alpha": False,
            "bits": 16 if config.linear else 8,
            "focal_px": focal,
        }
    )


def _bytes_of(photo: Photo) -> io.BytesIO:
    return io.BytesIO(read_recorded(photo.path, photo.digest))


def _left_out(photo: Photo, error: Exception) -> str:
    reason = error.args[0] if error.args else error
    text = reason.decode(errors="replace") if isinstance(reason, bytes) else str(reason)
    return f"{photo.name}: RAW file left out, it cannot be read ({text})"
