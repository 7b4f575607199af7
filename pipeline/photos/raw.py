"""Development of RAW files with the same settings for all photographs of a scene.

LibRaw's defaults choose brightness and white balance for each image, which makes the photographs of
a scene inconsistent. Here all photographs share the exposure, and photographs of one camera body
share the white balance.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import rawpy
from numpy.typing import NDArray

from pipeline.config.schema import Decode
from pipeline.io.recorded import read_recorded
from pipeline.photos.linear_image import Developed
from pipeline.scene.manifest import Photo

DEMOSAIC = {
    "linear": rawpy.DemosaicAlgorithm.LINEAR,
    "ahd": rawpy.DemosaicAlgorithm.AHD,
    "aahd": rawpy.DemosaicAlgorithm.AAHD,
}
SRGB_GAMMA = (2.4, 12.92)  # LibRaw's default is the curve of BT.709.


@dataclass(frozen=True)
class _Balance:
    """The white balances of a RAW file.

    Attributes:
        body: The identity of the camera body (its colour matrix).
        as_shot, daylight: (4,) float64 factors relative to green; ``as_shot`` is None if the file
            has none.
    """

    body: bytes
    as_shot: NDArray[np.float64] | None
    daylight: NDArray[np.float64]


class RawDeveloper:
    """Develops RAW files with common settings.

    Args:
        photos: The scene's RAW files, from which the common white balances are computed.
        pool: The executor that reads the files. It does not change the result.
    """

    def __init__(self, photos: Sequence[Photo], config: Decode, pool: ThreadPoolExecutor):
        self._config = config
        self._balances = dict(
            zip((photo.name for photo in photos), pool.map(_balance, photos), strict=True)
        )
        readable = [b for b in self._balances.values() if isinstance(b, _Balance)]
        self._common = _common_balance(readable, config)

    def develop(self, photo: Photo) -> Developed:
        """Develop one of the photographs.

        Raises:
            ValueError: LibRaw cannot read it.
        """
        balance = self._balances[photo.name]
        if isinstance(balance, str):
            raise ValueError(balance)
        return _develop_one(photo, self._common[balance.body], self._config)


def _balance(photo: Photo) -> _Balance | str:
    """The white balances of a RAW file, or the reason why it cannot be read."""
    try:
        with rawpy.imread(_bytes_of(photo)) as raw:
            body = np.asarray(raw.rgb_xyz_matrix).tobytes()
            as_shot = np.array(raw.camera_whitebalance, np.float64)
            daylight = np.array(raw.daylight_whitebalance, np.float64)
    except rawpy.LibRawError as error:
        return _reason(error)
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


def _develop_one(photo: Photo, balance: list[float], config: Decode) -> Developed:
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
        raise ValueError(_reason(error)) from None
    return Developed(rgb)


def _bytes_of(photo: Photo) -> io.BytesIO:
    return io.BytesIO(read_recorded(photo.path, photo.digest))


def _reason(error: Exception) -> str:
    reason = error.args[0] if error.args else error
    return reason.decode(errors="replace") if isinstance(reason, bytes) else str(reason)
