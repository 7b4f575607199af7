"""A photograph's position from its metadata: EXIF's GPS directory, and XMP of drones.

EXIF stores latitude and longitude without a sign; the hemispheres are tags of their own. A position
whose hemisphere is unknown is not used, and an altitude that is missing is unknown, not 0.
Sources: EXIF 2.32 and 3.0, section 4.6.6; DJI's "drone-dji" namespace; Adobe's "XMP Specification
Part 2" (exif:GPSLatitude).
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, Protocol

from PIL import ExifTags

_GPS = ExifTags.GPS

Position = tuple[float, float, float | None]
"""Latitude and longitude in degrees, altitude in metres; None for an unknown altitude."""
Fault = Literal["hemisphere", "range", "zero", "incomplete"]
"""Why a position in the metadata is not used."""

FAULTS: Mapping[Fault, str] = {
    "hemisphere": "GPS positions without their hemisphere (GPSLatitudeRef, GPSLongitudeRef) are "
    "not used, because it is never guessed; 'exiftool -GPSLatitudeRef=N -GPSLongitudeRef=E' adds "
    "it",
    "range": "GPS positions out of range (latitude -90 to 90, longitude -180 to 180) are not used",
    "zero": "GPS positions at latitude 0, longitude 0, which receivers without a fix write, are "
    "not used",
    "incomplete": "GPS positions without a number for latitude or longitude are not used",
}
# Altitudes of photographs: from the deepest trench to the highest balloon, metres.
_ALTITUDES = (-12_000.0, 60_000.0)
# XMP is searched for text, not parsed as XML: no entities.
XMP_VALUE = rb"\s*(?:=\s*[\"']|>)\s*"
_SIGNED = rb"([+-]?[0-9]{1,6}(?:\.[0-9]{1,15})?)"


class Gps(NamedTuple):
    """A photograph's position, or why there is none; both are None without GPS metadata."""

    position: Position | None = None
    fault: Fault | None = None


class HasFault(Protocol):
    """Facts about a photograph."""

    @property
    def gps_fault(self) -> Fault | None: ...


def read_gps(tags: Mapping[int, Any], xmp: bytes = b"") -> Gps:
    """The position of a photograph.

    Args:
        tags: EXIF's GPS directory.
        xmp: The file's XMP packet, empty without one. It is used for what EXIF does not give.
    """
    found = _from_exif(tags)
    if found.position is not None and found.position[2] is not None:
        return found
    other = _from_xmp(xmp)
    if found.position is None:
        return found if other is None else Gps(other)
    return Gps((*found.position[:2], other[2])) if other is not None else found


def fault_warnings(facts: Mapping[str, HasFault]) -> list[str]:
    """One sentence for each kind of fault among photographs (name -> facts)."""
    names: dict[Fault, list[str]] = defaultdict(list)
    for name in sorted(facts):
        fault = facts[name].gps_fault
        if fault is not None:
            names[fault].append(name)
    return [
        f"{len(names[fault])} {text} (first: {names[fault][0]})"
        for fault, text in FAULTS.items()
        if fault in names
    ]


def _from_exif(tags: Mapping[int, Any]) -> Gps:
    values = tags.get(_GPS.GPSLatitude), tags.get(_GPS.GPSLongitude)
    if values == (None, None):
        return Gps()
    latitude, longitude = (_degrees(value) for value in values)
    if math.isnan(latitude) or math.isnan(longitude):
        return Gps(fault="incomplete")
    if not _in_range(latitude, longitude):
        return Gps(fault="range")
    if latitude == longitude == 0:
        return Gps(fault="zero")
    signed = (
        _signed(latitude, tags.get(_GPS.GPSLatitudeRef), "NS"),
        _signed(longitude, tags.get(_GPS.GPSLongitudeRef), "EW"),
    )
    if signed[0] is None or signed[1] is None:
        return Gps(fault="hemisphere")
    return Gps((signed[0], signed[1], _altitude(tags)))


def _in_range(latitude: float, longitude: float) -> bool:
    return abs(latitude) <= 90 and abs(longitude) <= 180


def _degrees(value: Any) -> float:
    """Degrees of up to three numbers (degrees, minutes, seconds); NaN if there are none."""
    parts = list(value) if isinstance(value, tuple | list) else [value]
    if not 1 <= len(parts) <= 3:
        return math.nan
    degrees, *rest = (number_or_nan(part) for part in parts)
    # Some programs write 0/0 for the seconds.
    fractions = [part if math.isfinite(part) else 0.0 for part in rest]
    if any(not 0 <= part <= 60 for part in fractions) or not math.isfinite(degrees):
        return math.nan
    fraction = sum(part / 60**power for power, part in enumerate(fractions, start=1))
    return degrees - fraction if degrees < 0 else degrees + fraction


def _signed(degrees: float, reference: Any, letters: str) -> float | None:
    """Degrees with the sign of the hemisphere; None if that is unknown or contradictory."""
    if isinstance(reference, bytes):
        reference = reference.decode("ascii", "replace")
    text = reference.strip("\0 \t").upper() if isinstance(reference, str) else ""
    names = {"N": "NORTH", "S": "SOUTH", "E": "EAST", "W": "WEST"}
    hemisphere = next((c for c in letters if text in (c, names[c])), None)
    if hemisphere is None:
        # EXIF has no negative degrees: a program that writes them means a signed number.
        return degrees if degrees < 0 and not text else None
    if hemisphere == letters[1]:
        return -abs(degrees)
    return degrees if degrees >= 0 else None


def _altitude(tags: Mapping[int, Any]) -> float | None:
    """Metres above the reference; None if it is missing, no number or impossible. Receivers that
    measure no altitude write exactly 0, which counts as unknown."""
    altitude, reference = number_or_nan(tags.get(_GPS.GPSAltitude)), tags.get(_GPS.GPSAltitudeRef)
    if isinstance(reference, tuple | list) and len(reference) == 1:
        reference = reference[0]
    if isinstance(reference, bytes | str) and len(reference) == 1:
        reference = ord(reference) if ord(reference) < 4 else number_or_nan(reference)
    # 0 and 2 are above, 1 and 3 below the ellipsoid or the sea; EXIF's default is 0.
    if reference not in (None, 0, 1, 2, 3, "", b""):
        return None
    return _possible(-abs(altitude) if reference in (1, 3) else altitude)


def _possible(altitude: float) -> float | None:
    return altitude if altitude and _ALTITUDES[0] <= altitude <= _ALTITUDES[1] else None


def number_or_nan(value: Any) -> float:
    """``value`` as a float, NaN if it is not a number."""
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return math.nan


def _from_xmp(xmp: bytes) -> Position | None:
    """The position in DJI's signed numbers or in Adobe's "30,10.5N"."""
    latitude, longitude = _drone(xmp, rb"Latitude"), _drone(xmp, rb"Long?(?:i|t)tude")
    if latitude is None or longitude is None:
        latitude = _adobe(xmp, rb"Latitude", "NS")
        longitude = _adobe(xmp, rb"Longitude", "EW")
    if latitude is None or longitude is None:
        return None
    if not _in_range(latitude, longitude) or latitude == longitude == 0:
        return None
    altitude = re.search(rb"drone-dji:AbsoluteAltitude" + XMP_VALUE + _SIGNED, xmp)
    return latitude, longitude, _possible(float(altitude[1])) if altitude else None


def _drone(xmp: bytes, axis: bytes) -> float | None:
    found = re.search(rb"drone-dji:Gps" + axis + XMP_VALUE + _SIGNED, xmp)
    return float(found[1]) if found else None


def _adobe(xmp: bytes, axis: bytes, letters: str) -> float | None:
    number = rb"([0-9]{1,3}),([0-9]{1,2}(?:\.[0-9]{1,12})?)(?:,([0-9]{1,2}(?:\.[0-9]{1,12})?))?"
    found = re.search(rb"exif:GPS" + axis + XMP_VALUE + number + b"([NSEW])", xmp)
    if not found or found[4].decode() not in letters:
        return None
    degrees = _degrees([float(part) for part in found.groups()[:3] if part is not None])
    return None if math.isnan(degrees) else _signed(degrees, found[4], letters)
