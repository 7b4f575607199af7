"""GeoKeys: the coordinate reference system of a GeoTIFF file.

Source: OGC GeoTIFF 1.1 (19-008r4), section 7.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from pyproj import CRS

_USER_DEFINED = 32767
_PROJECTED, _PIXEL_IS_AREA = 1, 1
# Keys: of the model, of the raster, of projected and of vertical systems.
_MODEL_TYPE, _RASTER_TYPE = 1024, 1025
_PROJECTED_CRS, _PROJECTED_CITATION, _LINEAR_UNITS, _LINEAR_UNIT_SIZE = 3072, 3073, 3076, 3077
_VERTICAL_CRS = 4096
# Tags that hold the values of keys.
_DOUBLE_PARAMS, _ASCII_PARAMS = 34736, 34737
# EPSG codes of units by their length in metres.
_UNITS = {1.0: 9001, 0.3048: 9002, 1200 / 3937: 9003}


class GeoKeys(NamedTuple):
    """The values of the tags GeoKeyDirectory, GeoDoubleParams and GeoAsciiParams; the latter two
    may be empty."""

    directory: tuple[int, ...]
    doubles: tuple[float, ...]
    text: str


def geo_keys(crs: CRS) -> GeoKeys:
    """The keys of a projected system, alone or with a vertical system.

    A system without an EPSG code is user-defined: its WKT is in the citation, with the prefix by
    which Esri's programs and GDAL recognise it if the model's type is user-defined too.
    """
    horizontal, vertical = _parts(crs)
    code = horizontal.to_epsg()
    entries: list[tuple[int, int, int, int]] = [
        (_MODEL_TYPE, 0, 1, _PROJECTED if code else _USER_DEFINED),
        (_RASTER_TYPE, 0, 1, _PIXEL_IS_AREA),
        (_PROJECTED_CRS, 0, 1, code or _USER_DEFINED),
    ]
    doubles: tuple[float, ...] = ()
    text = ""
    if code is None:
        # A bar ends a key's text.
        text = f"ESRI PE String = {_wkt(horizontal)}".replace("|", " ") + "|"
        entries.append((_PROJECTED_CITATION, _ASCII_PARAMS, len(text), 0))
        metres = float(horizontal.axis_info[0].unit_conversion_factor)
        unit = next((epsg for size, epsg in _UNITS.items() if abs(size - metres) < 1e-12), None)
        entries.append((_LINEAR_UNITS, 0, 1, unit or _USER_DEFINED))
        if unit is None:
            doubles = (metres,)
            entries.append((_LINEAR_UNIT_SIZE, _DOUBLE_PARAMS, 1, 0))
    if vertical is not None and (vertical_code := vertical.to_epsg()) is not None:
        entries.append((_VERTICAL_CRS, 0, 1, vertical_code))
    directory = (1, 1, 1, len(entries), *(value for entry in entries for value in entry))
    return GeoKeys(directory, doubles, text)


def _wkt(crs: CRS) -> str:
    """Esri's WKT; GDAL's for the few systems that Esri's cannot describe."""
    from pyproj.exceptions import CRSError

    try:
        return str(crs.to_wkt("WKT1_ESRI"))
    except CRSError:
        return str(crs.to_wkt("WKT1_GDAL"))


def _parts(crs: CRS) -> tuple[CRS, CRS | None]:
    """The projected system and the vertical one, if there is one."""
    if crs.is_bound and crs.source_crs is not None:
        return _parts(crs.source_crs)
    if crs.is_compound:
        horizontal, *rest = crs.sub_crs_list
        return _parts(horizontal)[0], next((part for part in rest if part.is_vertical), None)
    return crs, None
