"""The size of a mesh's voxels compared with the size of the scene, before any job starts."""

from __future__ import annotations

from pipeline.config.schema import Config
from pipeline.config.section import MAX_MESH_VOXELS
from pipeline.plan.scan import Scan
from pipeline.plan.settle import gps_extent_m
from pipeline.runtime.errors import UserError

# Without GPS and given poses, most cameras are within one unit of their mean.
_LEVEL_EXTENT = 2.0
# A voxel that is this many times the extent of the cameras is larger than anything that they see.
_TOO_LARGE = 1000.0
# The number of voxels, per squared extent, of a surface as large as a cube around the cameras: six
# sides, each in a layer of two truncation distances and a block.
_VOXELS_PER_AREA = 6 * 20
_BYTES_PER_VOXEL = 8


def check_mesh_voxel(scan: Scan, config: Config) -> list[str]:
    """Compare ``export.mesh_voxel`` with the extent of the scene's cameras.

    Returns:
        A sentence about the number of voxels if they will be larger than configured.

    Raises:
        UserError: The voxels are larger than the scene.
    """
    voxel = config.export.mesh_voxel
    extent, unit = _camera_extent(scan, config)
    if voxel is None or "mesh" not in config.export.formats or not extent:
        return []
    if voxel > _TOO_LARGE * extent:
        raise UserError(
            f"export.mesh_voxel: expected voxels smaller than the scene, found {voxel:g}: the "
            f"cameras are within {extent:.3g} {unit}",
            fix="lower it, or leave it out for voxels of 2.5 pixels",
        )
    count = _VOXELS_PER_AREA * (extent / voxel) ** 2
    if count <= MAX_MESH_VOXELS:
        return []
    return [
        f"export.mesh_voxel: voxels of {voxel:g} would be about {count:.1g} "
        f"({count * _BYTES_PER_VOXEL / 1e9:.2g} GB) for cameras within {extent:.3g} {unit}; the "
        f"mesh has at most {MAX_MESH_VOXELS / 1e6:g} million, which are larger if need be"
    ]


def _camera_extent(scan: Scan, config: Config) -> tuple[float | None, str]:
    """The extent of the cameras as far as the plan can tell, and its unit in words."""
    if scan.poses is not None:
        return scan.given_extent, "units of the given poses"
    wanted = config.sfm.georeference
    if scan.ground_control is not None and wanted in ("auto", "gcp"):
        return None, ""
    if wanted in ("auto", "gps") and (metres := gps_extent_m(scan)) > 0:
        return max(metres, _LEVEL_EXTENT), "m (GPS)"
    return _LEVEL_EXTENT, "units of the scene, which is scaled by its cameras"
