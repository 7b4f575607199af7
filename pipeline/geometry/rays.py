"""Unit rays through pixels and their inverse for every camera model, vectorised, in float64.

Unlike the normalised coordinates of ``distortion``, rays exist at 90 degrees and more from the
optical axis: fisheye lenses of more than 180 degrees and panoramas have such pixels.

Formulas: COLMAP's documentation, "Camera Models" (the fisheye models are Kannala and Brandt 2006
with the polynomial r = theta + k1 theta^3 + ...; EQUIRECTANGULAR has the longitude along x and the
latitude along y, the optical axis at the centre of the image).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import distortion
from pipeline.geometry.cameras import Camera

Array = NDArray[np.float64]


def rays(camera: Camera, xy: Array) -> Array:
    """Unit vectors in the camera's frame through pixels: (..., 2) to (..., 3).

    NaN where the model has no ray: beyond the radius at which the distortion folds over, and
    outside of a panorama's latitudes.
    """
    xy = np.asarray(xy, np.float64)
    if camera.is_spherical:
        return _panorama_rays(camera, xy)
    if camera.model in distortion.POLYNOMIAL_FISHEYES:
        return _fisheye_rays(camera, xy)
    plane = distortion.unproject(camera, xy)
    found = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)
    found /= np.linalg.norm(found, axis=-1, keepdims=True)
    return np.where(np.isfinite(plane).all(axis=-1, keepdims=True), found, np.nan)


def pixels(camera: Camera, directions: Array) -> Array:
    """Pixels (..., 2) of directions (..., 3) in the camera's frame, which need not be unit vectors.

    NaN where the lens has no image of a direction: behind a perspective camera, and beyond
    ``max_angle`` for a fisheye lens. Pixels may be outside of the image.
    """
    directions = np.asarray(directions, np.float64)
    x, y, z = np.moveaxis(directions, -1, 0)
    if camera.is_spherical:
        longitude, latitude = np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))
        width, height = camera.params
        return np.stack(
            [(longitude / (2 * np.pi) + 0.5) * width, (0.5 - latitude / np.pi) * height], axis=-1
        )
    if camera.model in distortion.POLYNOMIAL_FISHEYES:
        fx, fy, cx, cy = camera.pinhole
        radius = np.hypot(x, y)
        theta = np.arctan2(radius, z)
        scale = distortion.fisheye_radius(camera, theta) / np.where(radius > 0, radius, 1.0)
        scale = np.where(theta <= max_angle(camera), scale, np.nan)
        return np.stack([x * scale * fx + cx, y * scale * fy + cy], axis=-1)
    front = z > 0
    plane = directions[..., :2] / np.where(front, z, 1.0)[..., None]
    front = front & (np.hypot(plane[..., 0], plane[..., 1]) < distortion.fold_radius(camera))
    found = distortion.project(camera, np.where(front[..., None], plane, 0.0))
    return np.where(front[..., None], found, np.nan)


def max_angle(camera: Camera) -> float:
    """The largest angle from the optical axis, in radians, at which the model has rays."""
    if camera.is_spherical:
        return float(np.pi)
    if camera.model in distortion.POLYNOMIAL_FISHEYES:
        return distortion.max_fisheye_angle(camera)
    return float(np.arctan(distortion.fold_radius(camera)))


def _panorama_rays(camera: Camera, xy: Array) -> Array:
    width, height = camera.params
    longitude = (xy[..., 0] / width - 0.5) * 2 * np.pi
    latitude = (0.5 - xy[..., 1] / height) * np.pi
    cosine = np.cos(latitude)
    found = np.stack(
        [cosine * np.sin(longitude), -np.sin(latitude), cosine * np.cos(longitude)], axis=-1
    )
    return np.where(np.abs(latitude)[..., None] <= np.pi / 2 + 1e-12, found, np.nan)


def _fisheye_rays(camera: Camera, xy: Array) -> Array:
    fx, fy, cx, cy = camera.pinhole
    plane = (xy - (cx, cy)) / (fx, fy)
    radius = np.hypot(plane[..., 0], plane[..., 1])
    theta = distortion.fisheye_angle(camera, radius)
    sine = np.where(radius > 1e-12, np.sin(theta) / np.maximum(radius, 1e-12), 1.0)
    found = np.concatenate([plane * sine[..., None], np.cos(theta)[..., None]], axis=-1)
    return np.where(np.isfinite(theta)[..., None], found, np.nan)
