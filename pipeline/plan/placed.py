"""Whether a scene can have a place on the earth, which some export formats need."""

from __future__ import annotations

from pipeline.config.export import PLACED_FORMATS
from pipeline.config.schema import Config
from pipeline.plan.scan import Scan
from pipeline.runtime.errors import UserError


def check_placed(scan: Scan, config: Config) -> None:
    """Check formats in ``export.formats`` that need GPS positions or ground control points.

    Raises:
        UserError: Such a format is wanted, and nothing can place the scene. Whether GPS positions
            suffice is known after reconstruction.
    """
    wanted = [name for name in config.export.formats if name in PLACED_FORMATS]
    if not wanted:
        return
    what = f"export.formats: {', '.join(wanted)} needs a scene with a place on the earth"
    if scan.poses is not None:
        raise UserError(
            f"{what}, and given poses are in a world of their own",
            fix="leave the format out, or let the poses be estimated from photographs with GPS or "
            "ground control points (poses: ignore)",
        )
    frame = config.sfm.georeference
    if (frame != "gcp" or scan.ground_control is None) and (frame != "gps" or not scan.num_gps):
        why = "sfm.georeference is none" if frame == "none" and scan.num_gps else "it has none"
        raise UserError(
            f"{what}, by GPS positions in the photographs or by ground control points; {why}",
            fix="add gcp_list.txt (docs/guides/georeference.md) or photographs with GPS, or leave "
            "the format out",
        )
