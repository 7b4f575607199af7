"""What is behind a scene, by what its photographs show: sky, a backdrop, or nothing to be seen.

Evidence is measured in reduced photographs, of which poses and points are known. It is a share of
all pixels or of those at the pictures' borders, so that thresholds do not depend on their size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.config.settled import Background
from pipeline.photos.load import load_view
from pipeline.scene.background import SceneBackground
from pipeline.scene.views import View, evenly_spaced, resized, view_size

# The longer side of the reduced photographs, pixels, and the maximum number of them.
SIDE, MAX_PICTURES = 160, 24
# More points than these are thinned: those of a whole scene lie closer than ``POINT_DISTANCE``.
MAX_POINTS = 50_000
# Borders are compared in pictures of this side: their outermost pixels are 3 % of a side.
BORDER_SIDE = 32
# A border's pixel has one colour if it is that close (in [0, 1]) to its median in this share of the
# pictures: noise, and objects that sometimes reach the border.
SAME, SAME_SHARE = 0.06, 0.9
# A backdrop is this share of the border, and the cameras have turned by so many degrees: what is
# far away stays where it is in pictures of one heading.
BACKDROP_SHARE, MIN_TURN = 0.7, 30.0
# A backdrop is black below, and white above, these values of all channels.
BLACK, WHITE = 0.12, 0.88
# Masks that exclude this share of the borders leave an object that stands alone.
ALONE_SHARE = 0.5
# Sky is smooth (the range of colours around a pixel), and larger than this share of a picture.
SMOOTH, MIN_REGION = 0.06, 0.02
# There are no points within this distance in pixels: nothing there could be matched.
POINT_DISTANCE = 4
# Sky is hardly redder than blue, unlike walls in the light of lamps.
REDNESS = 0.05
# Sky is seen in this share of the photographs, and in at least so many: a bright wall or a window
# fills the edge of a single one.
SKY_SHARE, MIN_SKY = 0.15, 2


@dataclass(frozen=True)
class Picture:
    """A reduced photograph.

    Attributes:
        view: The camera at the size of the picture.
        rgb: (H, W, 3) float32 in [0, 1].
        valid: (H, W) bool, the pixels that its mask keeps; None without a mask.
    """

    view: View
    rgb: NDArray[np.float32]
    valid: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Evidence:
    """What the photographs show.

    Attributes:
        excluded: The share of the borders that masks exclude.
        fixed: The share of the border that has the same colour in all photographs.
        colour: The median colour of this share, RGB in [0, 1].
        turn: The largest angle between two optical axes, degrees.
        sky: The share of the photographs with pixels that look like sky; 0 for a single one.
    """

    excluded: float = 0.0
    fixed: float = 0.0
    colour: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: float = 0.0
    sky: float = 0.0


def measure_evidence(
    views: Sequence[View], xyz: NDArray[np.float64], up: NDArray[np.float64]
) -> Evidence:
    """Measure the evidence in at most ``MAX_PICTURES`` of the views.

    Args:
        views: At least one.
        xyz: (P, 3) the points of the scene, world.
        up: (3,) the scene's up direction, unit length.

    Raises:
        UserError: See ``photos.load.load_view``.
    """
    chosen = evenly_spaced(views, MAX_PICTURES)
    pictures = [_picture(view) for view in chosen]
    xyz = _thinned(xyz)
    borders, excluded = zip(*map(_border, pictures), strict=True)
    fixed, colour = _fixed(np.stack(borders))
    axes = np.stack([view.world_to_camera[2, :3] for view in chosen])
    # A matrix product of BLAS may round differently with the number of threads.
    cosine = np.einsum("ik,jk->ij", axes, axes).min()
    sky = sum(bool(sky_pixels(picture, xyz, up).any()) for picture in pictures)
    return Evidence(
        excluded=float(np.mean(excluded)),
        fixed=fixed,
        colour=colour,
        turn=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
        sky=sky / len(chosen) if sky >= MIN_SKY else 0.0,
    )


class SkyMasks:
    """The pixels of photographs that look like sky; none if too few photographs have any.

    Args:
        views, xyz, up: As those of ``measure_evidence``.

    Raises:
        UserError: See ``photos.load.load_view``.
    """

    def __init__(self, views: Sequence[View], xyz: NDArray[np.float64], up: NDArray[np.float64]):
        xyz = _thinned(xyz)
        found = {}
        for view in views:
            picture = _picture(view)
            sky = sky_pixels(picture, xyz, up)
            if sky.any():
                found[view.name] = _to_the_edge(picture.rgb, sky)
        enough = len(found) >= max(MIN_SKY, SKY_SHARE * len(views))
        self._found = found if enough else {}

    def __len__(self) -> int:
        """The number of photographs that show sky."""
        return len(self._found)

    def of(self, view: View) -> NDArray[np.bool_]:
        """Whether each pixel (H, W) is sky. Borders are those of the reduced photograph."""
        if view.name not in self._found:
            return np.zeros((view.height, view.width), bool)
        mask = self._found[view.name].astype(np.uint8)
        size = (view.width, view.height)
        return cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST).astype(bool)


def choose_background(evidence: Evidence) -> SceneBackground:
    """The background that the evidence speaks for."""
    if evidence.excluded >= ALONE_SHARE:
        return SceneBackground(
            background="black",
            reason=f"black background: masks exclude {evidence.excluded:.0%} of the photographs' "
            "borders, so the object stands alone",
        )
    if evidence.fixed >= BACKDROP_SHARE and evidence.turn >= MIN_TURN:
        background: Background = "skybox"
        if max(evidence.colour) < BLACK:
            background = "black"
        elif min(evidence.colour) > WHITE:
            background = "white"
        red, green, blue = (round(255 * value) for value in evidence.colour)
        return SceneBackground(
            background=background,
            reason=f"{background} background: {evidence.fixed:.0%} of the photographs' border has "
            f"the same colour ({red}, {green}, {blue}) in all of them, a backdrop",
        )
    sky = f"{evidence.sky:.0%} of the photographs show sky"
    if evidence.sky >= SKY_SHARE:
        return SceneBackground(background="skybox", reason=f"a skybox behind the scene: {sky}")
    return SceneBackground(
        background="fill",
        reason=f"a fill behind the scene, in the colours of the nearest points: {sky}",
    )


def _thinned(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """At most ``MAX_POINTS`` of the points (P, 3)."""
    return xyz[:: math.ceil(len(xyz) / MAX_POINTS) or 1]


def _picture(view: View) -> Picture:
    small = resized(view, *view_size(view.width, view.height, SIDE))
    pixels = load_view(small)
    return Picture(small, np.asarray(pixels.rgb / 255, np.float32), pixels.mask)


def sky_pixels(
    picture: Picture, xyz: NDArray[np.float64], up: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """(H, W) bool: pixels that look like sky: regions above the horizon that are smooth, bright and
    not red, reach the upper edge, and have no point in front of them."""
    view, rgb = picture.view, picture.rgb
    height, width = rgb.shape[:2]
    kernel = np.ones((3, 3), np.uint8)
    smooth = (cv2.dilate(rgb, kernel) - cv2.erode(rgb, kernel)).max(2) < SMOOTH
    empty = smooth & ~_near_points(view, xyz)
    if picture.valid is not None:
        empty &= picture.valid
    x = (np.arange(width) + 0.5 - view.cx) / view.fx
    y = (np.arange(height) + 0.5 - view.cy) / view.fy
    right, down, ahead = view.world_to_camera[:3, :3] @ up
    empty &= x * right + y[:, None] * down + ahead > 0
    found = np.zeros((height, width), bool)
    brightness = rgb.mean(2)
    labels = cv2.connectedComponents(empty.astype(np.uint8), connectivity=4)[1]
    if abs(down) >= abs(right):
        top = labels[-1 if down > 0 else 0]
    else:
        top = labels[:, -1 if right > 0 else 0]
    for label in np.unique(top[top > 0]):
        region = labels == label
        red, _, blue = rgb[region].mean(0)
        bright = brightness[region].mean() >= np.median(brightness)
        if region.mean() > MIN_REGION and bright and red - blue < REDNESS:
            found |= region
    return found


def _to_the_edge(rgb: NDArray[np.float32], sky: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The sky, and the pixels beside it of its colour there: ``sky_pixels`` leaves them out, since
    points on the silhouettes of buildings are near."""
    side = (2 * (POINT_DISTANCE + 1) + 1,) * 2
    share = cv2.blur(sky.astype(np.float32), side)
    nearby = cv2.blur(rgb * sky[..., None], side) / np.maximum(share, 1e-6)[..., None]
    return np.asarray(sky | ((share > 1e-6) & (np.abs(rgb - nearby).max(2) < SMOOTH)))


def _near_points(view: View, xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(H, W) bool: pixels within ``POINT_DISTANCE`` of a point in front of the camera."""
    near = np.zeros((view.height, view.width), np.uint8)
    camera = np.einsum("ij,pj->pi", view.world_to_camera[:3, :3], xyz)
    camera += view.world_to_camera[:3, 3]
    x, y, z = camera[camera[:, 2] > 0].T
    u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
    inside = (u >= 0) & (u < view.width) & (v >= 0) & (v < view.height)
    near[v[inside].astype(int), u[inside].astype(int)] = 1
    side = 2 * POINT_DISTANCE + 1
    return cv2.dilate(near, np.ones((side, side), np.uint8)) > 0


def _border(picture: Picture) -> tuple[NDArray[np.float32], float]:
    """(4 ``BORDER_SIDE`` - 4, 3) colours of the picture's border, NaN where a mask excludes them,
    and the share of the excluded ones."""
    side = (BORDER_SIDE, BORDER_SIDE)
    small = cv2.resize(picture.rgb, side, interpolation=cv2.INTER_AREA)
    if picture.valid is not None:
        share = cv2.resize(picture.valid.astype(np.float32), side, interpolation=cv2.INTER_AREA)
        small[share < 0.999] = np.nan
    border = np.concatenate([small[0], small[-1], small[1:-1, 0], small[1:-1, -1]])
    return border, float(np.isnan(border[:, 0]).mean())


def _fixed(borders: NDArray[np.float32]) -> tuple[float, tuple[float, float, float]]:
    """The share of the borders' pixels (N, B, 3) that have the same colour in all pictures, and the
    median colour of these."""
    borders = borders[:, np.isfinite(borders).all(2).any(0)]
    if not borders.size:
        return 0.0, (0.0, 0.0, 0.0)
    difference = np.abs(borders - np.nanmedian(borders, 0)).max(2)
    known = np.isfinite(difference)
    same = ((difference < SAME) & known).sum(0) >= SAME_SHARE * known.sum(0)
    if not same.any():
        return 0.0, (0.0, 0.0, 0.0)
    red, green, blue = np.nanmedian(borders[:, same].reshape(-1, 3), 0).tolist()
    return float(same.mean()), (red, green, blue)
