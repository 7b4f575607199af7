"""SIFT features of one photograph by OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.photos.load import load_mask, read_picture
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Photo
from pipeline.sfm.keypoints import Keypoints, root_sift


class DetectionImage:
    """A photograph prepared for feature detection: downscaled, grey, with its mask.

    Attributes:
        grey: (h, w) uint8.
        rgb: (h, w, 3) uint8.
        usable: (h, w) uint8, zero for masked or transparent pixels; None without a mask or alpha.
        scale: (2,) size of a pixel of ``grey`` in pixels of the stored image, x and y.
    """

    def __init__(self, photo: Photo, max_long_side_px: int):
        pixels = read_picture(photo.path, photo.digest)
        height, width = pixels.shape[:2]
        reduction = min(1.0, max_long_side_px / max(width, height))
        size = (max(1, round(width * reduction)), max(1, round(height * reduction)))
        bgr, alpha = _split(pixels)
        usable = None if alpha is None else (alpha > 0).astype(np.uint8)
        if photo.mask is not None:
            mask = _read_mask(photo, (width, height))
            usable = mask if usable is None else usable & mask
        if reduction < 1:
            bgr = cv2.resize(bgr, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
        if reduction < 1 and usable is not None:
            usable = cv2.resize(usable, size, interpolation=cv2.INTER_NEAREST).astype(np.uint8)
        self.grey = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
        self.rgb = np.ascontiguousarray(bgr[..., ::-1])
        self.usable = usable
        self.scale = np.array([width / size[0], height / size[1]])

    def finish(
        self,
        xy: NDArray[np.float64],
        scale: NDArray[np.float64],
        orientation: NDArray[np.float64],
        descriptors: NDArray[np.uint8],
    ) -> Keypoints:
        """Convert keypoints detected in ``grey`` to keypoints of the stored image, sorted by
        scale, largest first.

        Args:
            xy: (F, 2) in pixels of ``grey``, pixel centres at .5.
            scale, orientation: (F,) sigma in pixels of ``grey``, and radians.
            descriptors: (F, 128).
        """
        pixel = np.floor(xy).astype(np.int64)
        rows = np.clip(pixel[:, 1], 0, self.grey.shape[0] - 1)
        columns = np.clip(pixel[:, 0], 0, self.grey.shape[1] - 1)
        order = np.lexsort((orientation, xy[:, 1], xy[:, 0], -scale))
        return Keypoints(
            xy=(xy * self.scale).astype(np.float32)[order],
            scale=(scale * self.scale.mean()).astype(np.float32)[order],
            orientation=orientation.astype(np.float32)[order],
            descriptors=np.ascontiguousarray(descriptors[order]),
            rgb=np.ascontiguousarray(self.rgb[rows, columns][order]),
        )


def detect(picture: DetectionImage, max_features: int, contrast_threshold: float) -> Keypoints:
    """SIFT keypoints with RootSIFT descriptors (``keypoints.root_sift``): the ``max_features`` of
    strongest response among the usable pixels. ``contrast_threshold`` is OpenCV's."""
    sift = cv2.SIFT_create(  # type: ignore[attr-defined]
        # OpenCV selects the strongest before it applies the mask: with a mask, select below.
        nfeatures=max_features if picture.usable is None else 0,
        contrastThreshold=contrast_threshold,
        # Otherwise keypoints are biased by a quarter of a pixel.
        enable_precise_upscale=True,
    )
    if picture.usable is None:
        found, descriptors = sift.detectAndCompute(picture.grey, None)
    else:
        found = sift.detect(picture.grey, picture.usable)
        found = sorted(found, key=lambda k: (-k.response, k.pt, k.size, k.angle))[:max_features]
        found, descriptors = sift.compute(picture.grey, found)
    # OpenCV returns more keypoints if responses are equal.
    found = list(found)[:max_features]
    table = np.array([(*k.pt, k.size, k.angle) for k in found], np.float64).reshape(-1, 4)
    if descriptors is None or not found:
        descriptors = np.zeros((0, 128), np.float32)
    # OpenCV's pixel centres are at integers, COLMAP's at .5; OpenCV's size is a diameter.
    return picture.finish(
        table[:, :2] + 0.5,
        table[:, 2] / 2,
        np.radians(table[:, 3]),
        root_sift(descriptors[: len(found)]),
    )


def write_grey(picture: DetectionImage, path: str) -> None:
    """Write ``picture.grey`` as PNG."""
    if not cv2.imwrite(path, picture.grey):
        raise UserError("cannot be written", file=path, fix="check free space and permissions")


def _split(pixels: NDArray) -> tuple[NDArray[np.uint8], NDArray | None]:
    """8-bit BGR composited over black, and the alpha channel, None without one."""
    if pixels.dtype == np.uint16:
        alpha_scale, pixels8 = 65535.0, (pixels // 257).astype(np.uint8)
    else:
        alpha_scale, pixels8 = 255.0, pixels
    if pixels8.ndim == 2:
        return np.repeat(pixels8[..., None], 3, axis=2), None
    if pixels8.shape[2] in (2, 4):
        alpha = pixels[..., -1]
        colour = pixels8[..., :-1] * (alpha[..., None] / alpha_scale)
        colour = np.repeat(colour, 3, axis=2) if colour.shape[2] == 1 else colour
        return np.rint(colour).astype(np.uint8), alpha
    if pixels8.shape[2] == 1:
        return np.repeat(pixels8, 3, axis=2), None
    return np.ascontiguousarray(pixels8[..., :3]), None


def _read_mask(photo: Photo, size: tuple[int, int]) -> NDArray[np.uint8]:
    """The photograph's mask at the size of the image: (h, w) uint8, 1 for the pixels that count."""
    assert photo.mask is not None
    usable = load_mask(photo.mask, photo.mask_digest).astype(np.uint8)
    if (usable.shape[1], usable.shape[0]) != size:
        usable = cv2.resize(usable, size, interpolation=cv2.INTER_NEAREST).astype(np.uint8)
    return usable
