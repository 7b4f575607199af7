"""Point clouds as LAZ files: LAS 1.4, compressed, points of format 7 (with colours), normals as
extra dimensions, the coordinate system as WKT.

Sources: ASPRS LAS 1.4 R15; OGC 01-009 for the WKT; PDAL's names of normals.
"""

from __future__ import annotations

import io
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.runtime.atomic import write_bytes

if TYPE_CHECKING:
    from pyproj import CRS

# Steps of coordinates, in the unit of the system.
STEP = 0.001
NORMALS = ("NormalX", "NormalY", "NormalZ")
# The day and year of the header's creation date. Zeros mean none: the same points, the same bytes.
_DATE_OFFSET, _NO_DATE = 90, b"\0" * 4


def write_laz(
    path: Path,
    xyz: NDArray[np.float64],
    rgb: NDArray[np.uint8],
    normals: NDArray[np.float32],
    crs: CRS,
) -> None:
    """Write a point cloud, atomically.

    Args:
        xyz: (N, 3) coordinates in ``crs``, east before north.
        rgb: (N, 3) colours; in the file they have 16 bits, 255 is 65535.
        normals: (N, 3) unit normals.
        crs: A projected system, alone or with a vertical one.
    """
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    header = laspy.LasHeader(version="1.4", point_format=7)
    header.generating_software = "splatmake"
    header.creation_date = date.min
    header.scales = np.full(3, STEP)
    header.offsets = np.floor(xyz.min(0)) if len(xyz) else np.zeros(3)
    header.add_extra_dims([laspy.ExtraBytesParams(name, np.float32) for name in NORMALS])
    header.vlrs.append(WktCoordinateSystemVlr(_wkt(crs)))
    header.global_encoding.wkt = True
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = xyz.T
    cloud.red, cloud.green, cloud.blue = rgb.T.astype(np.uint16) * 257
    cloud.return_number[:] = cloud.number_of_returns[:] = 1
    for name, values in zip(NORMALS, normals.T, strict=True):
        cloud[name] = values
    buffer = io.BytesIO()
    cloud.write(buffer, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
    buffer.seek(_DATE_OFFSET)
    buffer.write(_NO_DATE)
    write_bytes(path, buffer.getvalue())


def _wkt(crs: CRS) -> str:
    """WKT 1, which LAS 1.4 prescribes; WKT 2 for the few systems that it cannot describe."""
    from pyproj.exceptions import CRSError

    try:
        return str(crs.to_wkt("WKT1_GDAL"))
    except CRSError:
        return str(crs.to_wkt())
