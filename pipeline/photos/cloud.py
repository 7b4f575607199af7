"""Point clouds of other programs as sparse points: the points that the views see, with colours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.config.settled import Init
from pipeline.io.clouds.sampling import thinned
from pipeline.io.clouds.values import PointCloud
from pipeline.photos.load import load_view
from pipeline.plan.point_cloud import IN_POSES, IN_PROJECTION
from pipeline.runtime.errors import UserError
from pipeline.scene.georeference import Georeference
from pipeline.scene.reconstruction import Points
from pipeline.scene.views import View, evenly_spaced
from pipeline.scene.visibility import projected, visible

# A cloud with fewer points in the views is probably in another place.
MIN_POINTS = 100
# The number of views that points without colour are compared with, and that set the voxel size.
_COLOUR_VIEWS, _RESOLUTION_VIEWS = 60, 30
_GREY = 128


NOT_PLACED = (
    "the point cloud is not used: the estimated poses could not be georeferenced by ground control "
    "points in a projection; Gaussians are initialised from the sparse points"
)


def placed_points(
    cloud: PointCloud, georeference: Georeference | None, views: Sequence[View], config: Init
) -> Points | None:
    """The points of a cloud that views see, in the scene's world; None if the cloud cannot be
    placed there.

    Args:
        cloud: The cloud, in the scene's world if poses are given, else in the projection of the
            ground control points.
        georeference: The georeference of the poses; None for given poses in their own world.

    Raises:
        UserError: The views see too few points: the cloud is in another frame.
    """
    xyz, frame = cloud.xyz, IN_POSES
    if georeference is not None and georeference.method != "given":
        placed = georeference.from_projection(xyz)
        if placed is None:
            return None
        xyz, frame = placed, IN_PROJECTION
    points = points_of_cloud(cloud, xyz, views, config.max_points)
    if len(points) < min(MIN_POINTS, config.max_points):
        raise UserError(
            f"expected a point cloud in {frame}, found {len(points)} of its points in the views",
            file=config.points_file,
            fix="transform the cloud to that frame and unit, or set init.points_file: none",
        )
    return points


def points_of_cloud(
    cloud: PointCloud, xyz: NDArray[np.float64], views: Sequence[View], max_points: int
) -> Points:
    """At most ``max_points`` points of a cloud that are in the frustum of a view, one a voxel;
    voxels are smaller where views see more detail.

    Points without a colour get that of the nearest view that sees them, else grey.

    Args:
        xyz: The (N, 3) points of the cloud in the world of the views.
    """
    chosen = sampled(xyz, views, max_points)
    xyz, rgb = xyz[chosen], cloud.rgb[chosen].copy()
    missing = ~cloud.coloured[chosen]
    if missing.any():
        rgb[missing] = _colours(xyz, views)[missing]
    return Points.without_tracks(xyz, rgb)


def sampled(xyz: NDArray[np.float64], views: Sequence[View], max_points: int) -> NDArray[np.intp]:
    """Sorted indices of at most ``max_points`` of the points (N, 3) that are in the frustum of a
    view, one a voxel; voxels are smaller where views see more detail."""
    seen = np.flatnonzero(_in_frustums(xyz, views))
    return seen[thinned(xyz[seen], max_points, 1 / _resolution(xyz[seen], views))]


def _in_frustums(xyz: NDArray[np.float64], views: Sequence[View]) -> NDArray[np.bool_]:
    """(N,) whether a view's image contains the point, occluded or not."""
    seen = np.zeros(len(xyz), bool)
    for view in views:
        rest = np.flatnonzero(~seen)
        seen[rest] = projected(xyz[rest], view).inside
    return seen


def _resolution(xyz: NDArray[np.float64], views: Sequence[View]) -> NDArray[np.float64]:
    """(N,) pixels of the views per unit of length at each point: the root of the sum of squares
    over a sample of the views, occlusion ignored. Voxels in inverse proportion to it have about
    equally many pixels each."""
    total = np.zeros(len(xyz))
    for view in evenly_spaced(views, _RESOLUTION_VIEWS):
        _, z, inside = projected(xyz, view)
        total[inside] += view.fx * view.fy / z[inside] ** 2
    known = total[total > 0]
    least = float(known.min()) if len(known) else 1.0
    return np.sqrt(np.where(total > 0, total, least))


def _colours(xyz: NDArray[np.float64], views: Sequence[View]) -> NDArray[np.uint8]:
    """(N, 3) colours from the photographs: of the nearest view in which a point is not hidden."""
    rgb = np.full((len(xyz), 3), _GREY, np.uint8)
    nearest = np.full(len(xyz), np.inf)
    for view in evenly_spaced(views, _COLOUR_VIEWS):
        found = projected(xyz, view)
        rows = visible(found, view)
        rows = rows[found.z[rows] < nearest[rows]]
        column, row = found.xy[rows].astype(np.intp).T
        rgb[rows] = load_view(view).rgb[row, column]
        nearest[rows] = found.z[rows]
    return rgb
