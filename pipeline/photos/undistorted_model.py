"""The model of undistorted photographs: pinhole cameras, composed poses, moved observations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.geometry.distortion import project, unproject
from pipeline.geometry.rays import pixels, rays
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Part:
    """A view that was made of a photograph.

    Attributes:
        name: The view's name.
        camera_id: The id of the view's camera.
        rotation: (3, 3) rotation from the photograph's camera to the view's; None if the view is
            the whole photograph.
    """

    name: str
    camera_id: int
    rotation: Floats | None


def undistorted_model(
    model: Reconstruction, cameras: dict[int, Camera], parts: Mapping[str, Sequence[Part]]
) -> Reconstruction:
    """The model of the views.

    Image ids stay the same, unless photographs are split: then views are numbered from 1, in the
    order of their photographs' ids.

    Args:
        cameras: The cameras of the views.
        parts: The views of each photograph by its name.
    """
    sources = {number: parts[i.name] for number, i in model.images.items() if i.name in parts}
    whole = all(part.rotation is None for views in sources.values() for part in views)
    images: dict[int, PosedImage] = {}
    first: dict[int, int] = {}  # The id of a photograph's first view by the photograph's id.
    for number in sources if whole else sorted(sources):
        source = model.images[number]
        first[number] = number if whole else len(images) + 1
        for offset, part in enumerate(sources[number]):
            turn = np.eye(3) if part.rotation is None else part.rotation
            rotation, translation = source.rotation, source.translation
            if part.rotation is not None:
                rotation, translation = turn @ rotation, turn @ translation
            images[first[number] + offset] = PosedImage(
                part.name, part.camera_id, rotation, translation
            )
    points = model.points
    registered = np.isin(points.track_image_id, list(sources))
    owner = np.repeat(np.arange(len(points)), points.track_length)[registered]
    ids, xy = points.track_image_id[registered].copy(), points.track_xy[registered].copy()
    order = np.argsort(ids, kind="stable")
    ranges = {
        number: order[slice(*np.searchsorted(ids, [number, number + 1], sorter=order))]
        for number in sources
    }
    for number, views in sources.items():
        own = ranges[number]
        camera = model.cameras[model.images[number].camera_id]
        if views[0].rotation is None:
            target = cameras[views[0].camera_id]
            xy[own] = _inside(target, project(target, unproject(camera, xy[own])))
        else:
            chosen, xy[own] = _in_views(camera, xy[own], views, cameras)
            ids[own] = first[number] + chosen
    starts = np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=len(points)))])
    moved = Points(points.xyz, points.rgb, points.error, starts.astype(np.int64), ids, xy)
    return Reconstruction(cameras, images, moved)


def _inside(camera: Camera, xy: Floats) -> Floats:
    """``xy`` with NaN for pixels outside the image."""
    outside = np.any(~((xy >= 0) & (xy <= (camera.width, camera.height))), axis=1)
    xy[outside] = np.nan
    return xy


def _in_views(
    camera: Camera, xy: Floats, views: Sequence[Part], cameras: Mapping[int, Camera]
) -> tuple[NDArray[np.int64], Floats]:
    """For each pixel (N, 2) of a photograph, the index of the view in which it is nearest to the
    optical axis, and its pixel there; NaN if no view shows it."""
    directions = rays(camera, xy)
    placed, ahead = [], []
    for part in views:
        assert part.rotation is not None
        local = directions @ part.rotation.T
        seen = _inside(cameras[part.camera_id], pixels(cameras[part.camera_id], local))
        placed.append(seen)
        ahead.append(np.where(np.isfinite(seen).all(axis=1), local[:, 2], -2.0))
    chosen = np.argmax(ahead, axis=0)
    return chosen, np.stack(placed)[chosen, np.arange(len(xy))]
