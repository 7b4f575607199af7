"""A synthetic survey whose true world frame is known: cameras of a drone, their EXIF positions and
ground control points, in the arbitrary frame that structure from motion finds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags
from pyproj import Transformer

from pipeline.geometry.geodesy import to_enu
from pipeline.geometry.similarity import Similarity
from pipeline.geometry.up_direction import image_directions, up_direction
from pipeline.io.gps import Fault, Position, read_gps
from pipeline.sfm.gcp_frame import Pixels, Triangulated
from pipeline.sfm.georeference import Cameras

Array = NDArray[np.float64]
_GPS = ExifTags.GPS

WIDTH, HEIGHT, FOCAL = 1600, 1200, 1400.0
# The standard deviations of GPS along an axis and of altitudes, metres, and of marks, pixels.
GPS_M, ALTITUDE_M, MARK_PX = 1.5, 4.0, 0.7


@dataclass(frozen=True)
class Survey:
    """A synthetic survey.

    Attributes:
        origin: The latitude, longitude (degrees) and height (metres) of the origin of ``enu``.
        enu: The camera centres, (N, 3), metres east, north and up.
        rotations: The rotations from east, north, up to the cameras, (N, 3, 3).
        model: The similarity from the frame of structure from motion to east, north, up.
    """

    origin: Array
    enu: Array
    rotations: Array
    model: Similarity

    @property
    def names(self) -> list[str]:
        return [f"DJI_{number:04d}.JPG" for number in range(len(self.enu))]

    @property
    def cameras(self) -> Cameras:
        """The cameras as structure from motion returns them."""
        turned = self.rotations @ self.model.rotation
        upright = [1] * len(self.enu)
        return Cameras(
            self.names,
            in_model(self.model, self.enu),
            up_direction(turned, upright),
            image_directions(turned, upright),
        )

    def geodetic(self, enu: Array) -> Array:
        """The latitude, longitude and height of (N, 3) points, (N, 3), by Newton's method."""
        found = np.tile(self.origin, (len(enu), 1))
        scale = np.array([1.0, 1 / np.cos(np.radians(self.origin[0])), 111_194.0]) / 111_194.0
        for _ in range(20):
            found += (enu - to_enu(found, self.origin))[:, [1, 0, 2]] * scale
        return found

    def pixel(self, camera: int, point: Array) -> Array | None:
        """The pixel (COLMAP's convention) of a point east, north, up; None outside of the image."""
        x, y, z = self.rotations[camera] @ (point - self.enu[camera])
        if z <= 0:
            return None
        pixel = np.array([FOCAL * x / z + WIDTH / 2, FOCAL * y / z + HEIGHT / 2])
        return pixel if ((pixel > 0) & (pixel < (WIDTH, HEIGHT))).all() else None

    def triangulate(self, pixels: Pixels) -> Triangulated | None:
        """A point in the frame of structure from motion, from its pixels in photographs."""
        if len(pixels) < 2:
            return None
        numbers = [self.names.index(name) for name in sorted(pixels)]
        rays = []
        for number, name in zip(numbers, sorted(pixels), strict=True):
            px, py = pixels[name]
            local = np.array([(px - WIDTH / 2) / FOCAL, (py - HEIGHT / 2) / FOCAL, 1.0])
            rays.append(self.rotations[number].T @ local / np.linalg.norm(local))
        centres, d = self.enu[numbers], np.array(rays)
        across = np.eye(3) - d[:, :, None] * d[:, None, :]
        point = np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, centres))
        size = float(np.median(np.linalg.norm(centres - point, axis=1))) / FOCAL
        return Triangulated(in_model(self.model, point[None])[0], size / self.model.scale)


def in_model(model: Similarity, enu: Array) -> Array:
    return np.asarray((enu - model.translation) @ model.rotation / model.scale)


def drone_survey(
    rng: np.random.Generator,
    *,
    count: int = 24,
    path: Callable[[Array], Array] | None = None,
    origin: Sequence[float] = (47.37, 8.54, 410.0),
) -> Survey:
    """Cameras on two flights over about 100 m by 70 m that look obliquely at the ground, or along
    ``path``: (N,) positions along the flight in 0..1 -> (N, 3) metres."""
    t = (np.arange(count) + 0.5) / count
    if path is None:
        across = np.where(np.arange(count) % 2, -35.0, 35.0)
        enu = np.stack([np.linspace(-50, 50, count), across, 55 + 5 * rng.random(count)], 1)
    else:
        enu = path(t)
    enu = enu + rng.normal(0, 1.0, enu.shape) * (path is None)
    targets = rng.normal(0, 8.0, (count, 3)) * [1, 1, 0.1]
    rotations = np.stack([look_at(at, to) for at, to in zip(enu, targets, strict=True)])
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    turn = q * np.sign(np.linalg.det(q))
    model = Similarity(float(rng.uniform(5, 40)), turn, rng.normal(0, 100, 3))
    return Survey(np.array(origin, np.float64), enu, rotations, model)


def look_at(centre: Array, target: Array) -> Array:
    """The rotation from east, north, up to an upright camera that looks at ``target``."""
    ahead = (target - centre) / np.linalg.norm(target - centre)
    up = np.array([0.0, 0.0, 1.0]) if abs(ahead[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead])


# --- positions in EXIF --------------------------------------------------------------------

Tags = dict[int, Any]


def exif_tags(position: Array) -> Tags:
    """EXIF's GPS directory of latitude, longitude (degrees) and altitude (metres)."""
    latitude, longitude, altitude = position.tolist()
    longitude = (longitude + 180) % 360 - 180
    return {
        _GPS.GPSLatitudeRef: "N" if latitude >= 0 else "S",
        _GPS.GPSLatitude: _sexagesimal(abs(latitude)),
        _GPS.GPSLongitudeRef: "E" if longitude >= 0 else "W",
        _GPS.GPSLongitude: _sexagesimal(abs(longitude)),
        _GPS.GPSAltitudeRef: b"\x00" if altitude >= 0 else b"\x01",
        _GPS.GPSAltitude: abs(altitude),
    }


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    whole = int(degrees)
    minutes = int((degrees - whole) * 60)
    return float(whole), float(minutes), (degrees - whole - minutes / 60) * 3600


def measured_tags(survey: Survey, rng: np.random.Generator) -> list[Tags]:
    """The GPS directory of each photograph, with the errors of a consumer receiver."""
    error = rng.normal(size=survey.enu.shape) * (GPS_M, GPS_M, ALTITUDE_M)
    return [exif_tags(place) for place in survey.geodetic(survey.enu + error)]


def read_positions(
    survey: Survey, tags: Sequence[Tags]
) -> tuple[dict[str, Position], list[Fault | None]]:
    """The positions that the reader accepts, by photograph, and the faults of the others."""
    found: dict[str, Position] = {}
    faults: list[Fault | None] = []
    for name, own in zip(survey.names, tags, strict=True):
        gps = read_gps(own)
        faults.append(gps.fault)
        if gps.position is not None:
            found[name] = gps.position
    return found, faults


# --- ground control points ----------------------------------------------------------------


@dataclass(frozen=True)
class Mark:
    """A ground control point's place, (3,) metres east, north, up, and its pixel in photographs."""

    enu: Array
    pixels: Mapping[str, Array]


def marks(survey: Survey, places: Array, rng: np.random.Generator, views: int = 6) -> list[Mark]:
    """Points that up to ``views`` photographs show, with errors of marking."""
    found = []
    for place in places:
        seen: dict[str, Array] = {}
        for number in rng.permutation(len(survey.enu)):
            pixel = survey.pixel(int(number), place)
            if pixel is not None and len(seen) < views:
                seen[survey.names[number]] = pixel + rng.normal(0, MARK_PX, 2)
        found.append(Mark(place, seen))
    return found


def ground_places(rng: np.random.Generator, count: int) -> Array:
    """Random places on hilly ground, (count, 3)."""
    xy = rng.uniform((-35, -25), (35, 25), (count, 2))
    return np.column_stack([xy, 4 * np.sin(xy[:, 0] / 9) + 3 * np.cos(xy[:, 1] / 7)])


Change = Callable[[Array], Array]


def write_control(
    path: Path,
    survey: Survey,
    points: Sequence[Mark],
    *,
    header: str,
    code: str | None,
    change: Change = lambda rows: rows,
) -> None:
    """Write ``gcp_list.txt``.

    Args:
        header: The first line.
        code: The projection of the coordinates that are written; None: longitude and latitude.
        change: A mistake in the (N, 3) coordinates x, y, z.
    """
    places = survey.geodetic(np.array([point.enu for point in points]).reshape(-1, 3))
    rows = places[:, [1, 0, 2]]
    if code is not None:
        transformer = Transformer.from_crs(4326, code, always_xy=True)
        rows = np.column_stack([*transformer.transform(rows[:, 0], rows[:, 1]), rows[:, 2]])
    lines = [header]
    for point, row in zip(points, change(rows), strict=True):
        for name, (px, py) in point.pixels.items():
            x, y, z = (f"{value:.9f}" for value in row)
            lines.append(f"{x} {y} {z} {px - 0.5:.3f} {py - 0.5:.3f} {name}")
    path.write_text("\n".join(lines) + "\n")
