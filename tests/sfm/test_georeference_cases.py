"""No wrong world frame is silent: constructed surveys with few, narrow, wrong and incomplete GPS
positions and ground control points; and no position that is far off is used."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.georeference.cases import CASES, FEET, NEAR, by_control
from benchmarks.georeference.survey import drone_survey, measured_tags, read_positions
from benchmarks.georeference.verdict import verdict
from pipeline.sfm.gps_frame import from_gps

#: Words of the message about each mistake.
NAMED = {
    "GPS without hemispheres": "without their hemisphere",
    "GPS east instead of west": "upside down",
    "GPS east instead of west in half": "contradict each other",
    "GPS with latitude and longitude swapped": "upside down",
    "GPS with latitude and longitude swapped, out of range": "out of range",
    "GPS with altitudes in feet": "in feet",
    "GPS with one outlier of 10 km": "1 GPS positions are outliers",
    "GPS with altitude 0": "have no altitude",
    "GCP on a line": "lie on a line",
    "GCP with latitude before longitude": "in the order latitude, longitude",
    "GCP with latitude before longitude, out of range": "in the order latitude, longitude",
    "GCP with longitudes of the wrong sign": "wrong sign",
    "GCP with northing before easting": "in the order northing, easting",
    "GCP with northing before easting, both in the area": "in the order northing, easting",
    "3 GCP with northing before easting, both in the area": "in the order northing, easting",
    "GCP mirrored": "counted in the opposite direction",
    "GCP with z downwards": "z seems to be counted downwards",
    "GCP with z in feet": "z seems to be in feet",
    "GCP in US survey feet with z in metres": "z seems to be in metres",
    "GCP in feet in a metric projection, with GPS": "lengths by GPS are",
    "GCP without altitude": "have the height 0",
    "GCP with one outlier of 10 km": "1 ground control points are outliers",
    "GCP in the neighbouring UTM zone, with GPS": "km from the photographs' GPS",
}
#: Cases that are right input, or have enough of it.
RIGHT = (
    *("GPS on a line", "GPS at one height", "GPS across the date line", "GCP on a plane"),
    *("GPS with altitude 0 in half", "GPS without altitude in half", "5 ground control points"),
    *("GCP in EPSG:4326", "GCP in WGS84 with a tab", "GCP in EPSG:4258", "GCP in EPSG:4269"),
    *("GCP in +proj=latlong", "GCP in US survey feet (EPSG:2277)", "GCP on a facade"),
)


@pytest.mark.parametrize("name", CASES)
def test_no_case_is_silently_wrong(name: str) -> None:
    """On surveys that chose no threshold."""
    for seed in (101, 102):
        found = CASES[name](np.random.default_rng([seed, len(name)]))
        result = verdict(name, found, seed)
        assert result.verdict != "silently wrong", result
        assert NAMED.get(name, "") in result.said, result
        if name in RIGHT:
            assert found.frame is not None, result


def test_a_record_has_forty_cases_or_more() -> None:
    assert len(CASES) >= 40 and NAMED.keys() <= CASES.keys() and set(RIGHT) <= CASES.keys()


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(3, 24),
    outliers=st.integers(0, 8),
    far=st.floats(300, 2e6),
    vertical=st.booleans(),
)
def test_a_used_position_is_never_far_off(
    seed: int, count: int, outliers: int, far: float, vertical: bool
) -> None:
    """Neither horizontally nor vertically, whatever the others are."""
    rng = np.random.default_rng(seed)
    survey = drone_survey(rng, count=count)
    positions, _ = read_positions(survey, measured_tags(survey, rng))
    for name in survey.names[:outliers]:
        latitude, longitude, altitude = positions[name]
        assert altitude is not None
        east = 0.0 if vertical else far / 111_194 * rng.choice((-1, 1))
        altitude += min(far, 50_000) * float(rng.choice((-1, 1))) if vertical else 0.0
        positions[name] = latitude, longitude + float(east), altitude
    frame = from_gps(survey.cameras, positions)
    if isinstance(frame, str):
        return
    for residual in frame.residuals:
        if residual.used:
            assert residual.horizontal_m < 50 and abs(residual.vertical_m or 0.0) < 150


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(3, 9),
    code=st.sampled_from(["EPSG:32632", "EPSG:2056", "EPSG:3857", "EPSG:25832", NEAR, None]),
    swap=st.booleans(),
)
def test_any_projection_and_either_order(
    seed: int, count: int, code: str | None, swap: bool
) -> None:
    """The other order is refused or warned of: a triangle is congruent to its mirror image, so only
    the orientation of the photographs contradicts three points, or three of a few more."""
    header = code or "EPSG:4326"
    order = [1, 0, 2] if swap else [0, 1, 2]
    case = by_control(count, header=header, code=code, change=lambda rows: rows[:, order])
    result = verdict(header, case(np.random.default_rng(seed)), seed)
    assert result.verdict != "silently wrong", result
    if swap:
        assert result.verdict in ("refused", "warned"), result


@pytest.mark.parametrize("code", FEET)
def test_feet_of_any_definition_become_metres(code: str) -> None:
    factor, place = FEET[code]
    case = by_control(
        7, header=code, code=code, change=lambda rows: rows / [1, 1, factor], origin=place
    )
    result = verdict(code, case(np.random.default_rng(5)), 5)
    assert result.verdict == "right", result
