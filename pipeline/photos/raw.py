"""RAW files to pictures, all views of a scene developed alike.

LibRaw's defaults brighten every picture by its own histogram and balance it by its own guess:
fine for one picture, poison for a scene. Here nothing is chosen per picture.
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
SRGB_GAMMA = (2.4, 12.92)  # LibRaw's default is BT.709's
FIX = "Copy the file from the camera again, or remove it from the folder."


@dataclass(frozen=True)
class DecodeReport:
    """What became of the RAW files: the new manifest, and a warning for each left out."""

    manifest: Manifest
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _Balance:
    """A body's identity (its colour matrix) and its white balances, green 1: (4,) float64."""

    body: bytes
    as_shot: NDArray[np.float64] | None
    daylight: NDArray[np.float64]


def develop(manifest: Manifest, config: Decode, out: Path, *, threads: int) -> DecodeReport:
    """Develop the RAW files of ``manifest`` to ``out/images/<stem>.png`` and ``out/images.json``.

    8-bit sRGB, or 16-bit linear light with sRGB's primaries. One exposure for all; one white
    balance for all photographs of one body. The stored pixel grid is kept; sizes and focal
    lengths in the new manifest are those of the PNGs. Photographs that are not RAW stay as
    they are.

    Raises:
        UserError: not one RAW file could be read.
    """
    raws = [photo for photo in manifest.photos if photo.raw]
    names = rename({photo.name: ".png" if photo.raw else "" for photo in manifest.photos})
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        balances = dict(zip(raws, pool.map(_balance, raws), strict=True))
        warnings = [balance for balance in balances.values() if isinstance(balance, str)]
        whole = {photo: b for photo, b in balances.items() if isinstance(b, _Balance)}
        common = _common_balance(list(whole.values()), config)

        def work(photo: Photo) -> Photo | str:
            return _develop_one(photo, names[photo.name], common[whole[photo].body], config, out)

        jobs = pool.map(work, whole)
        results = dict(
            zip(whole, track(jobs, "developing RAW", len(whole), "photographs"), strict=True)
        )
    warnings += [result for result in results.values() if isinstance(result, str)]
    kept = {photo.name: result for photo, result in results.items() if isinstance(result, Photo)}
    if raws and not kept:
        raise UserError(
            f"none of the {len(raws)} RAW files could be read",
            file=Path(raws[0].path).parent,
            fix=FIX,
        )
    photos = [
        kept[photo.name] if photo.raw else photo
        for photo in manifest.photos
        if not photo.raw or photo.name in kept
    ]
    developed = Manifest(
        scene=manifest.scene,
        photos=tuple(sorted(photos, key=lambda photo: photo.name)),
        warnings=(*manifest.warnings, *warnings),
    )
    developed.write(out / "images.json")
    return DecodeReport(developed, tuple(warnings))


def _balance(photo: Photo) -> _Balance | str:
    """White balances of a RAW file, or the warning that says why there are none."""
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
    """One white balance for every body: the median as-shot one; daylight where none is told."""
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
    """The developed photograph, or the warning that says why there is none."""
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
    # Encoded and written apart: cv2.imwrite is silent about a full disk.
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
    return f"{photo.path}: RAW file left out, it cannot be read ({text})"
