"""A synthetic yard: level ground and a box, photographed from above, with exact depth maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.geometry.cameras import Camera
from pipeline.mvs.maps import DenseCloud, DenseMap, write_dense_cloud, write_map
from pipeline.scene.exposure import NO_GAINS
from pipeline.scene.georeference import CartesianOrigin, GeographicOrigin, Georeference
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from pipeline.scene.views import View
from pipeline.survey.outputs import SurveyScene

# The box in the scene's frame: west, south, east, north, and its height above the ground.
BOX, BOX_HEIGHT = (2.0, -1.0, 5.0, 2.0), 3.0
HEIGHT, FOCAL, SIZE = 30.0, 150.0, (120, 90)
GEOGRAPHIC = GeographicOrigin(latitude=-33.4, longitude=19.7, altitude=250.0)
CARTESIAN = CartesianOrigin(x=1_830_000.0, y=640_000.0, z=20.0)
FEET = "EPSG:2225"  # NAD83 / California zone 1, in US survey feet.
US_FOOT = 1200 / 3937


def georeference(origin=GEOGRAPHIC, projection=None, units=None) -> Georeference:
    return Georeference(
        method="gcp" if projection else "gps",
        axes="x east, y north, z up",
        unit="metres",
        origin=origin,
        projection=projection,
        projection_units_m=units,
        scale=1.0,
        rotation=np.eye(3).tolist(),
        translation=(0.0, 0.0, 0.0),
        residuals_m=None,
        residuals=(),
    )


def height(x, y):
    west, south, east, north = BOX
    inside = (x > west) & (x < east) & (y > south) & (y < north)
    return np.where(inside, BOX_HEIGHT, 0.0)


def colours(x, y):
    """Smooth colours, so that a cell's colour says where it is."""
    red, green = 128 + 8 * x, 128 + 8 * y
    return np.stack([red, green, np.where(height(x, y) > 0, 200, 50)], -1).clip(0, 255)


def _photograph(centre):
    """Depth and colours of a camera that looks down with north up."""
    width, rows = SIZE
    x = (np.arange(width) + 0.5 - width / 2) / FOCAL
    y = ((np.arange(rows) + 0.5 - rows / 2) / FOCAL)[:, None]
    roof = HEIGHT - BOX_HEIGHT
    at_roof = height(centre[0] + roof * x, centre[1] - roof * y) > 0
    depth = np.where(at_roof, roof, HEIGHT)
    east, north = centre[0] + depth * x, centre[1] - depth * y
    rgb = colours(east, north)
    # A wall of the box hides ground: it is dark blue.
    wall = ~at_roof & (height(east, north) > 0)
    rgb[wall] = 0
    return np.where(wall, 0, depth), np.rint(rgb).astype(np.uint8), east, north


def make_yard(folder: Path, frame: Georeference | None = None) -> SurveyScene:
    """A scene of nine photographs."""
    down = np.diag([1.0, -1.0, -1.0])
    camera = Camera("PINHOLE", *SIZE, np.array([FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2]))
    views, images, clouds = [], {}, []
    normal = np.zeros((*SIZE[::-1], 3), np.float32)
    normal[..., 2] = -1
    for number, (x, y) in enumerate((x, y) for x in (-5, 1, 7) for y in (-4, 0, 4)):
        centre, name = np.array([x, y, HEIGHT]), f"p{number}.png"
        depth, rgb, east, north = _photograph(centre)
        Image.fromarray(rgb).save(folder / name)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = down, -down @ centre
        focal, middle = (FOCAL, FOCAL), (SIZE[0] / 2, SIZE[1] / 2)
        views.append(View(name, str(folder / name), None, *SIZE, *focal, *middle, pose, False))
        images[number + 1] = PosedImage(name, 1, down, -down @ centre)
        known = depth > 0
        write_map(folder, name, DenseMap(depth.astype(np.float32), normal, known * np.float32(1)))
        xyz = np.stack([east, north, HEIGHT - depth], -1)[known]
        clouds.append((xyz, rgb[known]))
    xyz = np.concatenate([cloud[0] for cloud in clouds]).astype(np.float32)
    rgb = np.concatenate([cloud[1] for cloud in clouds])
    up = np.tile(np.array([0, 0, 1], np.float32), (len(xyz), 1))
    write_dense_cloud(folder, DenseCloud(xyz, up, rgb))
    points = Points(
        np.zeros((1, 3)),
        np.zeros((1, 3), np.uint8),
        np.array([0.4]),
        np.array([0, 9]),
        np.arange(1, 10),
        np.full((9, 2), np.nan),
    )
    model = Reconstruction({1: camera}, images, points)
    return SurveyScene(views, views, model, frame or georeference(), NO_GAINS, folder)
