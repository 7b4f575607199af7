"""GeoTIFF files in the layout of Cloud Optimized GeoTIFF: tiles, overviews, all directories first,
then the tiles of the smallest overview and so on to the full size.

The files are written here, from strips of rows, so that memory does not grow with the height of a
raster. tifffile cannot put the overviews before the full size, and rasterio would bring the whole
of GDAL.
Sources: TIFF 6.0, BigTIFF (libtiff), Adobe's TIFF Technical Note 3 (floating point predictor), OGC
GeoTIFF 1.1 (19-008r4), OGC Cloud Optimized GeoTIFF 1.0 (21-026).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.io.geokeys import geo_keys
from pipeline.runtime.atomic import written

if TYPE_CHECKING:
    from pyproj import CRS

Strip = NDArray[Any]

TILE = 256
NODATA = -9999.0
"""The value of unknown cells in rasters of floats."""
# Files from this size have offsets of 64 bits.
_BIG = 2**32 - 2**16
_LEVEL_OF_COMPRESSION = 6
# Types of tags: their code in the file, and that of ``struct``.
_TYPES = {"ascii": (2, "s"), "short": (3, "H"), "long": (4, "I"), "double": (12, "d")}
_LONG8 = (16, "Q")


@dataclass(frozen=True)
class Georeferenced:
    """The place of a raster with north up.

    Attributes:
        crs: A projected system, alone or with a vertical one.
        west, north: The outer corner of the upper left cell, in the system's unit.
        cell: The width and height of a cell in the system's unit.
    """

    crs: CRS
    west: float
    north: float
    cell: float


def write_geotiff(
    path: Path, strips: Iterable[Strip], width: int, height: int, place: Georeferenced
) -> None:
    """Write a raster, atomically. The same raster gives the same bytes.

    Args:
        strips: The rows from north to south, ``TILE`` at a time, fewer in the last strip:
            (R, W, 4) uint8 RGBA, not multiplied by alpha, or (R, W) float32 with ``NODATA`` for
            unknown cells. Memory: two strips at a time, and as much for all overviews together.

    Raises:
        ValueError: The strips do not have ``height`` rows of ``width`` cells.
    """
    with TemporaryFile(dir=path.parent if path.parent.is_dir() else None) as scratch:
        levels = [_Level(width, height, scratch)]
        while max(levels[-1].width, levels[-1].height) > TILE:
            last = levels[-1]
            levels.append(_Level(-(-last.width // 2), -(-last.height // 2), scratch))
            last.overview = levels[-1]
        for strip in strips:
            levels[0].add(strip)
        levels[0].finish()
        with written(path) as file:
            for piece in _container(levels, place):
                file.write(piece)
            for level in reversed(levels):
                level.copy_to(file)


@dataclass
class _Level:
    """A size of the raster, whose tiles are compressed into a file as their rows arrive.

    Attributes:
        scratch: The file of tiles, which all levels share.
        tiles: Offset and size in ``scratch`` of each tile, by rows.
        overview: The level of half the size.
        pending: Rows that the overview has not got.
    """

    width: int
    height: int
    scratch: IO[bytes]
    tiles: list[tuple[int, int]] = field(default_factory=list)
    overview: _Level | None = None
    pending: list[Strip] = field(default_factory=list)
    num_rows: int = 0
    is_float: bool = False

    def add(self, strip: Strip) -> None:
        """Store up to ``TILE`` rows, and pass on what the overview can use."""
        if self.num_rows % TILE or strip.shape[1] != self.width or len(strip) > TILE:
            raise ValueError(f"expected strips of {TILE} rows of {self.width} cells")
        self.is_float = strip.dtype == np.float32
        self.num_rows += len(strip)
        for left in range(0, self.width, TILE):
            data = zlib.compress(_tile(strip[:, left : left + TILE]), _LEVEL_OF_COMPRESSION)
            self.tiles.append((self.scratch.seek(0, 2), len(data)))
            self.scratch.write(data)
        if self.overview is not None:
            self.pending.append(halved(strip))
            if len(self.pending) == 2:
                self._pass_on(self.overview)

    def finish(self) -> None:
        """Complete the overviews after the last strip."""
        if self.num_rows != self.height:
            raise ValueError(f"expected {self.height} rows, found {self.num_rows}")
        if self.overview is not None:
            if self.pending:
                self._pass_on(self.overview)
            self.overview.finish()

    def _pass_on(self, overview: _Level) -> None:
        rows, self.pending = np.concatenate(self.pending), []
        overview.add(rows)

    @property
    def num_bytes(self) -> int:
        return sum(size for _, size in self.tiles)

    def copy_to(self, file: IO[bytes]) -> None:
        for offset, size in self.tiles:
            self.scratch.seek(offset)
            file.write(self.scratch.read(size))


def halved(strip: Strip) -> Strip:
    """The strip at half the size: means of the known cells of 2 x 2, colours weighted by alpha.

    Args:
        strip: (R, W, 4) uint8 RGBA or (R, W) float32; see ``write_geotiff``.
    """
    rows, width = strip.shape[:2]
    is_float = strip.ndim == 2
    pad = ((0, rows % 2), (0, width % 2), *([] if is_float else [(0, 0)]))
    strip = np.pad(strip, pad, constant_values=NODATA if is_float else 0)
    quarters = [strip[y::2, x::2] for y in (0, 1) for x in (0, 1)]
    if is_float:
        known = sum((quarter != NODATA).astype(np.float64) for quarter in quarters)
        total = sum(
            np.where(quarter != NODATA, quarter, 0).astype(np.float64) for quarter in quarters
        )
        mean = total / np.maximum(known, 1)
        return np.where(known > 0, mean, NODATA).astype(np.float32)
    weight = sum(quarter[..., 3:].astype(np.float64) for quarter in quarters)
    light = sum(quarter[..., :3] * quarter[..., 3:].astype(np.float64) for quarter in quarters)
    colour = np.rint(light / np.maximum(weight, 1e-9))
    return np.concatenate([colour, np.rint(weight / 4)], axis=-1).astype(np.uint8)


def _tile(part: Strip) -> bytes:
    """A tile after the predictor: differences of neighbours in a row, of floats by their bytes."""
    shape = (TILE, TILE, *part.shape[2:])
    full = np.full(shape, NODATA if part.ndim == 2 else 0, part.dtype)
    full[: part.shape[0], : part.shape[1]] = part
    if part.ndim == 2:
        # The most significant bytes of a row come first, then the next ones, and so on.
        planes = full.astype(">f4").view(np.uint8).reshape(TILE, TILE, 4)
        full = np.ascontiguousarray(planes.transpose(0, 2, 1)).reshape(TILE, 4 * TILE)
    difference = full.copy()
    difference[:, 1:] -= full[:, :-1]
    return difference.tobytes()


def _container(levels: list[_Level], place: Georeferenced) -> Iterator[bytes]:
    """The file's header and all directories; the tiles follow, those of the last level first."""
    tags = [_tags(level, place, first=level is levels[0]) for level in levels]
    total = sum(level.num_bytes for level in levels)
    # Sizes of directories depend on the size of offsets alone, so a first pass finds them.
    big = total + sum(len(level.tiles) * 16 + 4096 for level in levels) + 2**17 > _BIG
    yield struct.pack("<2sHHHQ", b"II", 43, 8, 0, 16) if big else struct.pack("<2sHI", b"II", 42, 8)
    start = 16 if big else 8
    sizes = [
        len(_directory(entries, [0] * len(level.tiles), 0, 0, big))
        for entries, level in zip(tags, levels, strict=True)
    ]
    data = {}
    position = start + sum(sizes)
    for number in reversed(range(len(levels))):
        data[number] = position
        position += levels[number].num_bytes
    for number, (level, entries) in enumerate(zip(levels, tags, strict=True)):
        lengths = [size for _, size in level.tiles]
        offsets = (data[number] + np.cumsum([0, *lengths[:-1]])).tolist()
        following = start + sizes[number] if number + 1 < len(levels) else 0
        yield _directory(entries, offsets, start, following, big)
        start += sizes[number]


def _tags(level: _Level, place: Georeferenced, *, first: bool) -> dict[int, tuple[str, Any]]:
    """The tags of a directory but for the tiles' offsets: type and values by number."""
    samples, bits = (1, (32,)) if level.is_float else (4, (8,) * 4)
    tags: dict[int, tuple[str, Any]] = {
        254: ("long", (0 if first else 1,)),  # NewSubfileType: 1 for a reduced image.
        256: ("long", (level.width,)),
        257: ("long", (level.height,)),
        258: ("short", bits),
        259: ("short", (8,)),  # Compression: deflate.
        262: ("short", (1 if level.is_float else 2,)),  # Photometric: grey or RGB.
        277: ("short", (samples,)),
        284: ("short", (1,)),  # PlanarConfiguration: samples of a pixel beside each other.
        317: ("short", (3 if level.is_float else 2,)),  # Predictor.
        322: ("short", (TILE,)),
        323: ("short", (TILE,)),
        325: ("long", tuple(size for _, size in level.tiles)),
        339: ("short", (3 if level.is_float else 1,) * samples),  # SampleFormat.
    }
    if not level.is_float:
        tags[338] = ("short", (2,))  # ExtraSamples: alpha, not multiplied.
    else:
        tags[42113] = ("ascii", f"{NODATA:g}")  # GDAL_NODATA.
    if first:
        keys = geo_keys(place.crs)
        tags[33550] = ("double", (place.cell, place.cell, 0.0))
        tags[33922] = ("double", (0.0, 0.0, 0.0, place.west, place.north, 0.0))
        tags[34735] = ("short", keys.directory)
        if keys.doubles:
            tags[34736] = ("double", keys.doubles)
        if keys.text:
            tags[34737] = ("ascii", keys.text)
    return tags


def _directory(
    tags: dict[int, tuple[str, Any]], offsets: list[int], start: int, following: int, big: bool
) -> bytes:
    """A directory with its values.

    Args:
        offsets: The offsets of the tiles in the file.
        start: The directory's own offset.
        following: The offset of the next directory; 0 for none.
        big: Whether offsets have 64 bits.
    """
    offset_type = _LONG8 if big else _TYPES["long"]
    values = {}
    for number, (name, content) in tags.items():
        kind, code = _TYPES[name]
        if name == "ascii":
            data = content.encode("ascii", "replace") + b"\0"
            values[number] = kind, len(data), data
        else:
            values[number] = kind, len(content), struct.pack(f"<{len(content)}{code}", *content)
    packed = struct.pack(f"<{len(offsets)}{offset_type[1]}", *offsets)
    values[324] = offset_type[0], len(offsets), packed
    count, entry, pointer = ("<Q", "<HHQ", "<Q") if big else ("<H", "<HHI", "<I")
    inline = struct.calcsize(pointer)
    size = struct.calcsize(count) + len(values) * (struct.calcsize(entry) + inline) + inline
    head, behind = [struct.pack(count, len(values))], b""
    for number in sorted(values):
        kind, length, data = values[number]
        if len(data) > inline:
            where = struct.pack(pointer, start + size + len(behind))
            behind += data + b"\0" * (-len(data) % 8)
            data = where
        head.append(struct.pack(entry, number, kind, length) + data.ljust(inline, b"\0"))
    head.append(struct.pack(pointer, following))
    return b"".join(head) + behind + b"\0" * (-(size + len(behind)) % 8)
