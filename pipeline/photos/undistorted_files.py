"""Loading photographs with their masks and depth maps, and writing their undistorted views."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.config import schema
from pipeline.io.names import suffix_of
from pipeline.io.recorded import digest_of
from pipeline.photos.encode import write_picture
from pipeline.photos.faces import Face, WideCamera, depth_factor, padded
from pipeline.photos.lens import Lens
from pipeline.photos.load import (
    Picture,
    load_mask,
    load_rgb,
    load_rgba,
    read_depth,
    resize_area,
    resize_mask,
    resize_rgba,
    to_8bit,
)
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Photo


@dataclass(frozen=True)
class Target:
    """One of the views that a camera's photographs become.

    Attributes:
        lens: The undistortion map of the view.
        camera_id: The camera's id in the written model.
        face, wide: The face and the wide camera of a photograph that is split, else None.
    """

    lens: Lens
    camera_id: int
    face: Face | None = None
    wide: WideCamera | None = None

    @property
    def rotation(self) -> NDArray[np.float64] | None:
        """(3, 3) rotation from the photograph's camera to the view's; None if it is not split."""
        return None if self.face is None else self.face.rotation


@dataclass(frozen=True)
class Source:
    """A photograph's pixels as stored, extended by ``padded`` if it is a panorama.

    Attributes:
        picture: (H, W, 3) uint8 or uint16.
        alpha: (H, W) uint8, or None.
        mask: (H, W) uint8, or None.
        depth: (H, W) values as stored, or None.
    """

    picture: Picture
    alpha: NDArray[np.uint8] | None
    mask: Picture | None
    depth: Picture | None


def load_source(photo: Photo, target: Target) -> Source:
    """Read a photograph with its mask and depth map."""
    alpha: NDArray[np.uint8] | None = None
    if photo.alpha:
        picture, alpha = load_rgba(photo.path, photo.digest)
    else:
        picture = load_rgb(photo.path, photo.digest)
    _check_size(picture, photo, photo.path)
    mask = depth = None
    if photo.mask is not None:
        mask = load_mask(photo.mask, photo.mask_digest).astype(np.uint8)
        mask = _nearest(mask, photo.width, photo.height)
    if photo.depth is not None:
        depth = _nearest(read_depth(photo.depth, photo.depth_digest), photo.width, photo.height)
    if target.wide is not None and target.wide.camera.is_spherical:
        alpha, mask, depth = (
            None if pixels is None else padded(pixels) for pixels in (alpha, mask, depth)
        )
        picture = padded(picture)
    return Source(picture, alpha, mask, depth)


def write_view(
    photo: Photo,
    source: Source,
    name: str,
    target: Target,
    config: schema.Undistort,
    out: Path,
) -> Photo:
    """Write one view with its mask and depth map, and return its entry in the manifest."""
    lens = target.lens
    width, height = lens.target.width, lens.target.height
    picture, alpha = _picture(source, lens)
    path = out / "images" / name
    if path.suffix == ".jpg":
        write_picture(path, _bgr(to_8bit(picture)), [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality])
    elif alpha is None:
        write_picture(path, _bgr(picture))
    else:
        write_picture(path, np.dstack([_bgr(picture), alpha]))

    mask = _mask(source, lens)
    mask_path = out / "masks" / f"{name}.png" if mask is not None else None
    if mask is not None and mask_path is not None:
        write_picture(mask_path, mask.astype(np.uint8) * 255)
    depth_path = None
    if source.depth is not None:
        suffix = suffix_of(str(photo.depth)).replace(".npz", ".npy")
        depth_path = out / "depths" / f"{name}{suffix}"
        _write_depth(source.depth, target, depth_path)
    return photo.model_copy(
        update={
            "name": name,
            "path": str(path),
            "width": width,
            "height": height,
            "digest": digest_of(path),
            "alpha": alpha is not None,
            "colours": "",
            "bits": 8 if path.suffix == ".jpg" or picture.dtype == np.uint8 else 16,
            "mask": None if mask_path is None else str(mask_path),
            "mask_digest": None if mask_path is None else digest_of(mask_path),
            "depth": None if depth_path is None else str(depth_path),
            "depth_digest": None if depth_path is None else digest_of(depth_path),
            "focal_px": float(lens.target.params[0]),
            "panorama": False,
            "source": None if target.face is None else photo.name,
        }
    )


def _picture(source: Source, lens: Lens) -> tuple[Picture, NDArray[np.uint8] | None]:
    """Undistorted and downscaled (H, W, 3) colours, uint8 or uint16, and (H, W) alpha."""
    size = (lens.target.width, lens.target.height)
    picture, alpha = source.picture, source.alpha
    if lens.x is None or alpha is None:
        new = lens.remap(picture, cv2.INTER_CUBIC, cv2.BORDER_REPLICATE)
        new_alpha = alpha
    else:
        # Colours are weighted by alpha: transparent pixels have no influence.
        weight = alpha.astype(np.float32)
        new_weight = lens.remap(weight, cv2.INTER_LINEAR, cv2.BORDER_CONSTANT)
        weighted = lens.remap(picture * weight[..., None], cv2.INTER_LINEAR, cv2.BORDER_CONSTANT)
        colour = weighted / np.maximum(new_weight, 1e-6)[..., None]
        new = np.rint(colour.clip(0, 255)).astype(np.uint8)
        new_alpha = np.rint(new_weight).astype(np.uint8)
    if lens.valid is not None:
        new = new * lens.valid[..., None]
        new_alpha = None if new_alpha is None else new_alpha * lens.valid
    if new_alpha is None:
        return resize_area(new, *size), None
    return resize_rgba(new, new_alpha, *size)


def _mask(source: Source, lens: Lens) -> NDArray[np.bool_] | None:
    """(H, W) mask of the undistorted image, True for valid pixels; None if all are valid."""
    size = (lens.target.width, lens.target.height)
    mask = None
    if source.mask is not None:
        new = lens.remap(source.mask, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)
        mask = resize_mask(new > 0, *size)
    if lens.valid is not None:
        # Partly blank pixels have a wrong colour.
        valid = resize_area(lens.valid.astype(np.float32), *size) > 0.999
        mask = valid if mask is None else mask & valid
    return None if mask is None else np.asarray(mask)


def _write_depth(depth: Picture, target: Target, path: Path) -> None:
    """Write the undistorted depth map, by nearest neighbour. Undistortion to one view does not
    change depth along z."""
    lens = target.lens
    depth = lens.remap(depth, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)
    if target.wide is not None and target.face is not None:
        factor = depth_factor(target.wide, target.face)
        if lens.valid is not None:
            factor = factor * lens.valid
        scaled = depth * factor
        depth = (np.rint(scaled) if depth.dtype.kind == "u" else scaled).astype(depth.dtype)
    depth = _nearest(depth, lens.target.width, lens.target.height)
    if path.suffix != ".npy":
        return write_picture(path, depth)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, depth)


def _nearest(picture: Picture, width: int, height: int) -> Picture:
    if picture.shape[:2] == (height, width):
        return picture
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_NEAREST_EXACT))


def _bgr(rgb: Picture) -> Picture:
    """Convert to BGR by cv2: its encoders are slower for a reversed view of an array."""
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))


def _check_size(picture: Picture, photo: Photo, path: str) -> None:
    if picture.shape[1::-1] != (photo.width, photo.height):
        raise UserError(
            f"is {picture.shape[1]}x{picture.shape[0]} pixels, "
            f"was {photo.width}x{photo.height} when the scene was inspected",
            file=path,
            fix="Do not change photographs while the program runs; start it again.",
        )
