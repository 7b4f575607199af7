"""The cases: what is measured, and the mistake in it. Each returns the frame that is found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags

from benchmarks.georeference.survey import (
    HEIGHT,
    WIDTH,
    Change,
    Survey,
    Tags,
    drone_survey,
    exif_tags,
    ground_places,
    marks,
    measured_tags,
    read_positions,
    write_control,
)
from pipeline.io.gcp import GCP_FILE, read_ground_control
from pipeline.io.gps import FAULTS
from pipeline.runtime.errors import UserError
from pipeline.sfm.frame_comparison import contradictions
from pipeline.sfm.gcp_frame import from_gcp
from pipeline.sfm.georeference import WorldFrame
from pipeline.sfm.gps_frame import from_gps

Array = NDArray[np.float64]
_GPS = ExifTags.GPS
FOOT = 0.3048


@dataclass
class Found:
    """What the program makes of a case.

    Attributes:
        frame: The world frame; None if there is none.
        said: The messages to the user.
    """

    survey: Survey
    frame: WorldFrame | None
    said: list[str] = field(default_factory=list)


Case = Callable[[np.random.Generator], Found]


def by_gps(survey: Survey, tags: Sequence[Tags]) -> Found:
    """The frame of the positions in EXIF."""
    positions, faults = read_positions(survey, tags)
    said = [FAULTS[fault] for fault in FAULTS if fault in faults]
    frame = from_gps(survey.cameras, positions)
    if isinstance(frame, str):
        return Found(survey, None, [*said, frame])
    return Found(survey, frame, [*said, *frame.decisions, *frame.warnings])


def few(count: int) -> Case:
    """A case with GPS in ``count`` photographs only, spread over the flight."""

    def case(rng: np.random.Generator) -> Found:
        survey = drone_survey(rng)
        tags = measured_tags(survey, rng)
        kept = set(np.linspace(0, len(tags) - 1, count).round().astype(int).tolist())
        return by_gps(survey, [own if i in kept else {} for i, own in enumerate(tags)])

    return case


def flight(path: Callable[[Array], Array]) -> Case:
    """GPS in all photographs of a flight along ``path``."""

    def case(rng: np.random.Generator) -> Found:
        survey = drone_survey(rng, path=path)
        return by_gps(survey, measured_tags(survey, rng))

    return case


def line(t: Array) -> Array:
    return np.stack([120 * t - 60, 0 * t - 30, 0 * t + 40], 1)


def mast(t: Array) -> Array:
    return np.stack([0 * t + 30, 0 * t - 30, 60 * t + 5], 1)


def tripod(t: Array) -> Array:
    return np.stack([0 * t + 20, 0 * t - 20, 0.01 * t + 1.6], 1)


def small_object(t: Array) -> Array:
    angle = 2 * np.pi * t
    return np.stack([1.5 * np.cos(angle), 1.5 * np.sin(angle), 1.5 + 0 * t], 1)


def same_height(t: Array) -> Array:
    angle = 2 * np.pi * t
    return np.stack([45 * np.cos(angle), 40 * np.sin(angle), 45 + 0 * t], 1)


def spiral(t: Array) -> Array:
    angle = 6 * np.pi * t
    return np.stack([45 * np.cos(angle), 40 * np.sin(angle), 25 + 60 * t], 1)


def tags_changed(
    change: Callable[[int, Tags], Tags],
    origin: Sequence[float] = (47.37, 8.54, 410.0),
    path: Callable[[Array], Array] | None = None,
) -> Case:
    """GPS in all photographs, with a mistake in some."""

    def case(rng: np.random.Generator) -> Found:
        survey = drone_survey(rng, origin=origin, path=path)
        tags = measured_tags(survey, rng)
        return by_gps(survey, [change(i, dict(own)) for i, own in enumerate(tags)])

    return case


def without(*names: int) -> Callable[[int, Tags], Tags]:
    return lambda _, own: {key: value for key, value in own.items() if key not in names}


def half(change: Callable[[int, Tags], Tags]) -> Callable[[int, Tags], Tags]:
    return lambda i, own: change(i, own) if i % 2 else own


def with_values(**values: object) -> Callable[[int, Tags], Tags]:
    named = {getattr(_GPS, name): value for name, value in values.items()}
    return lambda _, own: own | named


def swapped_tags(_: int, own: Tags) -> Tags:
    """Exchange latitude and longitude, as programs do that take "x, y" for their order."""
    return own | {
        _GPS.GPSLatitude: own[_GPS.GPSLongitude],
        _GPS.GPSLongitude: own[_GPS.GPSLatitude],
    }


def altitude_in_feet(_: int, own: Tags) -> Tags:
    return own | {_GPS.GPSAltitude: own[_GPS.GPSAltitude] / FOOT}


def far_outliers(count: int) -> Callable[[int, Tags], Tags]:
    """Positions 10 km east in ``count`` photographs."""

    def change(i: int, own: Tags) -> Tags:
        if i >= count:
            return own
        degrees, minutes, seconds = own[_GPS.GPSLongitude]
        return own | {_GPS.GPSLongitude: (degrees, minutes + 8, seconds)}

    return change


def high_outlier(i: int, own: Tags) -> Tags:
    return own | ({_GPS.GPSAltitude: own[_GPS.GPSAltitude] + 600} if i == 3 else {})


def no_fix(i: int, own: Tags) -> Tags:
    return exif_tags(np.zeros(3)) if i % 3 == 0 else own


def by_control(
    count: int,
    *,
    header: str = "WGS84 UTM 32N",
    code: str | None = "EPSG:32632",
    change: Change = lambda rows: rows,
    places: Callable[[Array], Array] = lambda xyz: xyz,
    gps: bool = False,
    origin: Sequence[float] = (47.37, 8.54, 410.0),
) -> Case:
    """A case of ground control points.

    Args:
        count: The number of points.
        header, code, change: See ``survey.write_control``.
        places: The function that moves the points, for example onto a line.
        gps: Whether the photographs have GPS positions as well.
    """

    def case(rng: np.random.Generator) -> Found:
        survey = drone_survey(rng, origin=origin)
        points = marks(survey, places(ground_places(rng, count)), rng)
        positions = read_positions(survey, measured_tags(survey, rng))[0] if gps else {}
        with TemporaryDirectory() as folder:
            path = Path(folder) / GCP_FILE
            write_control(path, survey, points, header=header, code=code, change=change)
            sizes = dict.fromkeys(survey.names, (WIDTH, HEIGHT))
            try:
                control = read_ground_control(path, sizes)
                frame = from_gcp(control, survey.triangulate, survey.cameras, path)
            except UserError as error:
                return Found(survey, None, [str(error)])
        if isinstance(frame, str):
            return Found(survey, None, [frame])
        said = [*frame.decisions, *frame.warnings]
        return Found(survey, frame, said + contradictions(frame, survey.cameras, positions))

    return case


def one_far(rows: Array) -> Array:
    away = np.zeros_like(rows)
    away[0, 0] = 10_000.0
    return rows + away


def on_line(xyz: Array) -> Array:
    t = np.linspace(-30, 30, len(xyz))
    return np.stack([t, 0.4 * t, 0.02 * t], 1)


def facade(xyz: Array) -> Array:
    return np.stack([xyz[:, 0], 0 * xyz[:, 0] + 5, np.abs(xyz[:, 1]) / 2], 1)


def flat(xyz: Array) -> Array:
    return xyz * [1, 1, 0]


TEXAS = (30.27, -97.74, 150.0)
#: The code of a projection in feet -> its metres per foot, and a place within it.
FEET = {
    "EPSG:2277": (1200 / 3937, TEXAS),  # Texas, US survey feet
    "EPSG:2222": (FOOT, (33.4, -110.5, 900.0)),  # Arizona, international feet
}
# A projection whose eastings and northings are about equal where the surveys are.
NEAR = "+proj=tmerc +lat_0=42 +lon_0=8.5 +x_0=594000 +datum=WGS84 +units=m"
#: Name -> case. The verdicts "refused" and "stated" are as good as "right".
CASES: dict[str, Case] = {
    **{f"GPS in {count} of 24 photographs": few(count) for count in range(6)},
    "GPS on a line": flight(line),
    "GPS on a vertical line": flight(mast),
    "GPS at one place": flight(tripod),
    "GPS around an object of 3 m": flight(small_object),
    "GPS at one height": flight(same_height),
    "GPS without hemispheres": tags_changed(
        without(_GPS.GPSLatitudeRef, _GPS.GPSLongitudeRef, _GPS.GPSAltitudeRef), TEXAS
    ),
    "GPS without hemispheres in half": tags_changed(
        half(without(_GPS.GPSLatitudeRef, _GPS.GPSLongitudeRef)), TEXAS
    ),
    "GPS east instead of west": tags_changed(with_values(GPSLongitudeRef="E"), TEXAS),
    "GPS south instead of north": tags_changed(with_values(GPSLatitudeRef="S")),
    "GPS east instead of west in half": tags_changed(half(with_values(GPSLongitudeRef="E")), TEXAS),
    "GPS with latitude and longitude swapped": tags_changed(swapped_tags),
    "GPS with latitude and longitude swapped, out of range": tags_changed(swapped_tags, TEXAS),
    "GPS without altitude": tags_changed(without(_GPS.GPSAltitude, _GPS.GPSAltitudeRef)),
    "GPS without altitude in half": tags_changed(
        half(without(_GPS.GPSAltitude, _GPS.GPSAltitudeRef))
    ),
    "GPS with altitude 0": tags_changed(with_values(GPSAltitude=0.0)),
    "GPS with altitude 0 in half": tags_changed(half(with_values(GPSAltitude=0.0))),
    "GPS with altitudes in feet": tags_changed(altitude_in_feet, path=spiral),
    "GPS with one outlier of 10 km": tags_changed(far_outliers(1)),
    "GPS with five outliers of 10 km": tags_changed(far_outliers(5)),
    "GPS with one altitude 600 m too high": tags_changed(high_outlier),
    "GPS with a third at latitude 0, longitude 0": tags_changed(no_fix),
    "GPS across the date line": tags_changed(lambda _, own: own, (-16.8, 179.9999, 30.0)),
    **{f"{count} ground control points": by_control(count) for count in range(6)},
    "GCP on a line": by_control(6, places=on_line),
    "GCP on a plane": by_control(7, places=flat),
    "GCP on a facade": by_control(7, places=facade),
    "GCP in EPSG:4326": by_control(7, header="EPSG:4326", code=None),
    "GCP in WGS84 with a tab": by_control(7, header="WGS84\t", code=None),
    "GCP in EPSG:4258": by_control(7, header="EPSG:4258", code=None),
    "GCP in EPSG:4269": by_control(7, header="EPSG:4269", code=None, origin=TEXAS),
    "GCP in +proj=latlong": by_control(7, header="+proj=latlong +datum=WGS84 +no_defs", code=None),
    "GCP with latitude before longitude": by_control(
        7, header="EPSG:4326", code=None, change=lambda rows: rows[:, [1, 0, 2]]
    ),
    "GCP with latitude before longitude, out of range": by_control(
        7, header="EPSG:4326", code=None, change=lambda rows: rows[:, [1, 0, 2]], origin=TEXAS
    ),
    "GCP with longitudes of the wrong sign": by_control(
        7, header="EPSG:4326", code=None, change=lambda rows: rows * [-1, 1, 1], origin=TEXAS
    ),
    "GCP with northing before easting": by_control(7, change=lambda rows: rows[:, [1, 0, 2]]),
    "3 GCP with northing before easting": by_control(3, change=lambda rows: rows[:, [1, 0, 2]]),
    "GCP with northing before easting, both in the area": by_control(
        7, header=NEAR, code=NEAR, change=lambda rows: rows[:, [1, 0, 2]]
    ),
    "3 GCP with northing before easting, both in the area": by_control(
        3, header=NEAR, code=NEAR, change=lambda rows: rows[:, [1, 0, 2]]
    ),
    "GCP mirrored": by_control(7, change=lambda rows: rows * [-1, 1, 1] + [1_000_000, 0, 0]),
    "GCP with z downwards": by_control(7, change=lambda rows: rows * [1, 1, -1]),
    "GCP with z in feet": by_control(7, change=lambda rows: rows / [1, 1, FOOT]),
    "GCP in US survey feet (EPSG:2277)": by_control(
        7,
        header="EPSG:2277",
        code="EPSG:2277",
        change=lambda rows: rows / [1, 1, 1200 / 3937],
        origin=TEXAS,
    ),
    "GCP in US survey feet with z in metres": by_control(
        7, header="EPSG:2277", code="EPSG:2277", origin=TEXAS
    ),
    "GCP in feet in a metric projection, with GPS": by_control(
        7, change=lambda rows: rows / FOOT, gps=True
    ),
    "GCP without altitude": by_control(7, change=lambda rows: rows * [1, 1, 0]),
    "GCP with one outlier of 10 km": by_control(7, change=one_far),
    "4 GCP with one outlier of 10 km": by_control(4, change=one_far),
    "GCP in the neighbouring UTM zone, with GPS": by_control(7, header="WGS84 UTM 33N", gps=True),
}
