"""Conversion of linear light to files: sRGB images with EXIF, or the DNG of a Bayer sensor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from pipeline.demo.cameras import FOCAL_MM, SENSOR_WIDTH_MM, WIDE, focal_35mm

Array = NDArray[np.float64]

MAKE, MODEL = "Splatmake", "Demo 1"
JPEG_QUALITY = 95
EXPOSURE_TIME, F_NUMBER, ISO = 1 / 60, 5.6, 100

# The matrix from XYZ (D65) to sensor colours: ColorMatrix in DNG files of the Canon EOS 6D.
COLOR_MATRIX = np.array(
    [[0.7034, -0.0804, -0.1014], [-0.4420, 1.2564, 0.2058], [-0.0851, 0.1994, 0.5758]]
)
# The matrix from linear sRGB to XYZ (D65): IEC 61966-2-1.
SRGB_TO_XYZ = np.array(
    [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]]
)
BLACK_LEVEL, WHITE_LEVEL = 1024, 15360  # In steps of 14 bits.
RGGB = ((0, 1), (1, 2))
# Google's "Photo Sphere XMP Metadata" of a whole sphere.
GPANO = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
    b'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
    b'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
    b'GPano:ProjectionType="equirectangular"/></rdf:RDF></x:xmpmeta>'
)


def srgb(light: Array) -> Array:
    """sRGB values in [0, 1] of linear light in [0, 1], clipped (IEC 61966-2-1)."""
    light = np.clip(light, 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def to_bytes(values: Array) -> NDArray[np.uint8]:
    return np.rint(np.clip(values, 0.0, 1.0) * 255).astype(np.uint8)


@dataclass(frozen=True)
class CameraBody:
    """The camera of a photograph as EXIF names it.

    Attributes:
        model: The name of the body.
        exposure_time: The exposure in seconds; None without exposure in EXIF.
    """

    model: str = MODEL
    exposure_time: float | None = None


def write_picture(
    path: Path,
    pixels: NDArray[np.uint8],
    taken: str,
    distortion: str = "none",
    body: CameraBody = CameraBody(),
) -> None:
    """Write (H, W, 3 or 4) sRGB pixels as JPEG or PNG, by the name, with EXIF of the lens.

    Wide lenses have no focal length in EXIF: a fisheye lens has a name, a panorama GPano metadata.

    Args:
        taken: The EXIF time, "YYYY:MM:DD hh:mm:ss".
        distortion: A key of ``LENSES``.
        body: The camera.
    """
    exif = Image.Exif()
    exif[271], exif[272], exif[274], exif[306] = MAKE, body.model, 1, taken
    photo = exif.get_ifd(0x8769)
    photo[36867] = taken
    if body.exposure_time is not None:
        photo[33434], photo[33437], photo[34855] = body.exposure_time, F_NUMBER, ISO
    options: dict[str, Any] = {}
    if distortion == "equirectangular":
        options["xmp"] = GPANO
    elif distortion in WIDE:
        photo[42036] = "Fisheye"
    else:
        photo[37386] = float(FOCAL_MM)
        photo[41486] = photo[41487] = pixels.shape[1] / SENSOR_WIDTH_MM * 10
        photo[41488] = 3  # The unit is pixels per centimetre.
        photo[41989] = focal_35mm(pixels.shape[1], pixels.shape[0])
    exif[0x8769] = photo
    # Other formats ignore the options of JPEG.
    Image.fromarray(pixels).save(path, exif=exif, quality=JPEG_QUALITY, subsampling=0, **options)


def white_balance() -> Array:
    """(3,) sensor response to white, scaled to a maximum of 1: AsShotNeutral of DNG."""
    answer = (COLOR_MATRIX @ SRGB_TO_XYZ).sum(axis=1)
    return np.asarray(answer / answer.max())


def expose(light: Array, noise: float, seed: tuple[int, int]) -> NDArray[np.uint16]:
    """The RGGB mosaic (H, W), 14 bits in uint16, of linear (H, W, 3) light.

    Args:
        noise: The standard deviation of the read noise in sensor steps; 0 for none.
    """
    matrix = COLOR_MATRIX @ SRGB_TO_XYZ
    matrix = matrix / matrix.sum(axis=1, keepdims=True) * white_balance()[:, None]
    height, width = light.shape[:2]
    mosaic = np.empty((height, width))
    for dy, row in enumerate(RGGB):
        for dx, channel in enumerate(row):
            # The product is written out: BLAS rounds differently with the number of threads.
            r, g, b = np.moveaxis(light[dy::2, dx::2], -1, 0)
            m = matrix[channel]
            mosaic[dy::2, dx::2] = m[0] * r + m[1] * g + m[2] * b
    steps = BLACK_LEVEL + (WHITE_LEVEL - BLACK_LEVEL) * np.clip(mosaic, 0.0, 1.0)
    if noise > 0:
        steps = steps + np.random.default_rng(seed).normal(0.0, noise, steps.shape)
    return np.rint(np.clip(steps, 0, 2**14 - 1)).astype(np.uint16)


def write_dng(path: Path, mosaic: NDArray[np.uint16], taken: str) -> None:
    """Write an RGGB mosaic as DNG 1.4 (Adobe's specification; TIFF 6.0, TIFF/EP tags)."""

    def rationals(values: Array, scale: int = 10_000) -> tuple[int, ...]:
        return tuple(int(v) for x in np.ravel(values) for v in (round(float(x) * scale), scale))

    tags = [
        (271, "s", 0, MAKE, True),
        (272, "s", 0, MODEL, True),
        (274, "H", 1, 1, True),
        (33421, "H", 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, "B", 4, tuple(c for row in RGGB for c in row), True),  # CFAPattern
        (33434, "2I", 1, (1, 60), True),  # ExposureTime
        (33437, "2I", 1, (56, 10), True),  # FNumber
        (34855, "H", 1, ISO, True),
        (36867, "s", 0, taken, True),  # DateTimeOriginal
        (37386, "2I", 1, (FOCAL_MM, 1), True),  # FocalLength
        (41486, "2I", 1, rationals(np.array(mosaic.shape[1] / SENSOR_WIDTH_MM * 10)), True),
        (41488, "H", 1, 3, True),  # FocalPlaneResolutionUnit: centimetre
        (
            41989,
            "H",
            1,
            focal_35mm(mosaic.shape[1], mosaic.shape[0]),
            True,
        ),  # FocalLengthIn35mmFilm
        (50706, "B", 4, (1, 4, 0, 0), True),  # DNGVersion
        (50708, "s", 0, f"{MAKE} {MODEL}", True),  # UniqueCameraModel
        (50714, "I", 1, BLACK_LEVEL, True),
        (50717, "I", 1, WHITE_LEVEL, True),
        (50721, "2i", 9, rationals(COLOR_MATRIX), True),  # ColorMatrix1
        (50728, "2I", 3, rationals(white_balance(), 1_000_000), True),  # AsShotNeutral
        (50778, "H", 1, 21, True),  # CalibrationIlluminant1: D65
    ]
    tifffile.imwrite(
        path,
        mosaic,
        photometric="CFA",
        datetime=taken,
        software="splatmake",
        metadata=None,
        extratags=tags,
    )
