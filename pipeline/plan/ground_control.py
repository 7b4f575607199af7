"""The scene's ground control points: what the plan reports about them, and the errors in them that
show before any pose is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.io.gcp import ground_control_file, read_ground_control
from pipeline.plan.scene_folder import SceneFolder
from pipeline.runtime.text import shortened
from pipeline.scene.manifest import Photo


@dataclass(frozen=True)
class GroundControlFile:
    """The path of the scene's file (None if there is none), and a description of its content."""

    path: Path | None = None
    text: str = ""


def find_ground_control(
    at: SceneFolder, photos: Sequence[Photo], *, posed: bool, complete: bool
) -> GroundControlFile:
    """The scene's ``gcp_list.txt`` (in any case), checked as far as that is possible without poses.

    Args:
        posed: Whether poses are given. These are not georeferenced.
        complete: Whether ``photos`` are all photographs; False if frames of videos will follow.

    Raises:
        UserError: There are two files, or the content cannot be used; see ``read_ground_control``.
    """
    path = ground_control_file(at.path)
    if path is None:
        return GroundControlFile()
    wanted = at.config.sfm.georeference
    if posed or wanted not in ("auto", "gcp"):
        why = "poses are given" if posed else f"sfm.georeference is {wanted}"
        at.warnings.append(f"{path.name} is not used, because {why}")
        return GroundControlFile(path, path.name)
    sizes = {photo.name: (photo.width, photo.height) for photo in photos}
    control = read_ground_control(path, sizes, complete=complete)
    at.warnings.extend(control.warnings)
    projection = control.projection
    text = f"{path.name}: {len(control.points)} points in {shortened(projection.name)}"
    if not projection.in_metres:
        heights = f"heights in units of {projection.vertical:.10g} m"
        if projection.geographic:
            text += f", {heights}, converted to metres"
        else:
            text += f" ({projection.unit}, {heights}), converted to metres"
    if not projection.vertical_known and not projection.geographic and projection.vertical != 1:
        at.warnings.append(
            f"{path.name}: {projection.name} does not say the unit of heights; they are read in "
            f"{projection.unit} units as x and y are"
        )
    return GroundControlFile(path, text)
