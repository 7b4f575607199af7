"""EXIF positions and XMP of any bytes, projections of any text, surveys with any coordinates."""

from __future__ import annotations

import io
import math
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from benchmarks.georeference.survey import (
    HEIGHT,
    WIDTH,
    Mark,
    Survey,
    drone_survey,
    exif_tags,
    ground_places,
    marks,
    write_control,
)
from pipeline.io.gcp import read_ground_control
from pipeline.io.gps import Position, read_gps
from pipeline.io.photofile import read_facts
from pipeline.io.projection import read_projection
from pipeline.runtime.errors import UserError
from pipeline.sfm.frame_comparison import contradictions
from pipeline.sfm.gcp_frame import from_gcp
from pipeline.sfm.georeference import WorldFrame
from pipeline.sfm.gps_frame import from_gps
from tests.fuzz.reader import Files, Reader

XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description drone-dji:GpsLatitude="+47.3701" '
    b'drone-dji:GpsLongitude="+8.5401" drone-dji:AbsoluteAltitude="+430.5" '
    b'exif:GPSLatitude="47,22.2N" exif:GPSLongitude="8,32.4E"/></x:xmpmeta>'
)
HEADERS = {
    "WGS84 UTM 32N": "EPSG:32632",
    "EPSG:4326": None,
    "EPSG:2056": "EPSG:2056",
    "+proj=utm +zone=32 +datum=WGS84 +units=us-ft +no_defs": "EPSG:32632",
    "+proj=latlong +datum=WGS84": None,
}


@cache
def survey() -> Survey:
    return drone_survey(np.random.default_rng(0), count=12)


@cache
def points() -> list[Mark]:
    rng = np.random.default_rng(1)
    return marks(survey(), ground_places(rng, 5), rng, views=3)


def control_seeds() -> Sequence[Files]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "gcp_list.txt"
        found = []
        for header, code in HEADERS.items():
            write_control(path, survey(), points(), header=header, code=code)
            found.append({path.name: path.read_bytes()})
        return found


def read_survey(folder: Path) -> object:
    """The frame of the points, compared with GPS."""
    sizes = dict.fromkeys(survey().names, (WIDTH, HEIGHT))
    path = folder / "gcp_list.txt"
    frame = from_gcp(read_ground_control(path, sizes), survey().triangulate, survey().cameras, path)
    if isinstance(frame, WorldFrame):
        assert len(str(frame.georeference())) < 100_000
        contradictions(frame, survey().cameras, gps_positions())
    return frame


@cache
def gps_positions() -> dict[str, Position]:
    places = survey().geodetic(survey().enu).tolist()
    return {name: tuple(place) for name, place in zip(survey().names, places, strict=True)}


def photo_seeds() -> Sequence[Files]:
    found = []
    for place in ([47.37, 8.54, 410.0], [-33.9, -70.6, -12.5]):
        exif = Image.Exif()
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(exif_tags(np.array(place)))
        buffer = io.BytesIO()
        Image.new("RGB", (8, 6)).save(buffer, "JPEG", exif=exif, xmp=XMP)
        found.append({"x.jpg": buffer.getvalue()})
    return found


def read_photo_gps(folder: Path) -> object:
    facts = read_facts(folder / "x.jpg")
    if facts.gps is not None:
        _check(facts.gps)
        others = dict(list(gps_positions().items())[1:])
        return from_gps(survey().cameras, {survey().names[0]: facts.gps} | others)
    return facts


def read_xmp(folder: Path) -> object:
    found = read_gps({}, (folder / "x.xmp").read_bytes())
    if found.position is None:
        raise UserError("expected a position")
    _check(found.position)
    return found


def _check(position: Position) -> None:
    latitude, longitude, altitude = position
    assert abs(latitude) <= 90 and abs(longitude) <= 180
    assert altitude is None or math.isfinite(altitude)


def read_header(folder: Path) -> object:
    text = (folder / "projection.txt").read_bytes().decode(errors="replace")
    try:
        projection = read_projection(text)
    except ValueError as error:
        raise UserError(str(error)) from None
    places = np.array([[8.5, 47.4, 400.0], [500_000.0, 5_000_000.0, 400.0], [1e300, -1e300, 0.0]])
    return projection.contains(places, 6.0), projection.distortion(places[:1])


GEOREFERENCE: dict[str, Reader] = {
    "gcp-frame": Reader(control_seeds, read_survey, weight=0.5),
    "gps-exif": Reader(photo_seeds, read_photo_gps),
    "gps-xmp": Reader(lambda: [{"x.xmp": XMP}], read_xmp),
    "projection": Reader(
        lambda: [{"projection.txt": header.encode()} for header in HEADERS], read_header
    ),
}
