"""What is lost when Gaussians are written in a format or read from one: the same sentences for the
export stage, the command ``convert`` and the Python interface."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.io.sog import count_small
from pipeline.io.sog_container import META
from pipeline.io.splat import share_of_clamped_colours
from pipeline.io.spz import count_out_of_range, ignored_content, share_of_clamped_harmonics
from pipeline.splats.arrays import GaussianSource

# A smaller share of Gaussians that a format cannot represent is no loss that can be seen.
TOLERATED_SHARE = 0.05
#: The formats that record Mip-Splatting's opacity compensation.
RECORDING = (".ply", ".spz", ".sog")


def suffix_of_format(path: Path) -> str:
    """The suffix that names the format of a file of Gaussians."""
    # A folder of the files of a SOG archive is named by this file.
    return ".sog" if path.name.lower() == META else path.suffix.lower()


def losses(path: Path, gaussians: GaussianSource) -> list[str]:
    """A sentence for everything of the Gaussians that the file at ``path`` does not hold.

    The suffix of ``path`` names the format.
    """
    suffix, found = suffix_of_format(path), []
    if suffix == ".spz":
        lost = count_out_of_range(gaussians)
        if lost > TOLERATED_SHARE * len(gaussians):
            found.append(
                f"{path.name}: {lost} of {len(gaussians)} Gaussians are too small or too large for "
                "the number format of SPZ in the unit of the poses. Use a PLY file, or give the "
                "poses in a unit in which the size of the scene is about 1 to 100"
            )
        clamped = share_of_clamped_harmonics(gaussians)
        if clamped > TOLERATED_SHARE:
            found.append(
                f"{path.name}: {clamped:.0%} of the Gaussians have colours or spherical harmonics "
                "outside of the range of SPZ, which are clamped. Use a PLY file to keep them"
            )
    if suffix == ".sog":
        small = count_small(gaussians)
        if small > TOLERATED_SHARE * len(gaussians):
            found.append(
                f"{path.name}: {small} of {len(gaussians)} Gaussians are smaller than half of a "
                "step of SOG's positions, which have 16 bits over the scene. Use a PLY or SPZ file "
                "to keep them apart"
            )
    if suffix == ".splat":
        clamped = share_of_clamped_colours(gaussians)
        if clamped > TOLERATED_SHARE:
            found.append(
                f"{path.name}: {clamped:.0%} of the Gaussians have colours outside of [0, 1], "
                "which are clamped. Use a PLY or SPZ file to keep them"
            )
        if gaussians.sh_degree > 0:
            found.append(
                f"{path.name}: the format holds no spherical harmonics: colours that depend on the "
                f"direction of view (degree {gaussians.sh_degree}) are left out. Use a PLY or SPZ "
                "file to keep them"
            )
    return found


def losses_of_reading(path: Path) -> list[str]:
    """A sentence for everything in a file of Gaussians that is not read."""
    ignored = ignored_content(path) if path.suffix.lower() == ".spz" else []
    return [f"{path}: {' and '.join(ignored)} are left out"] if ignored else []


def unmarked(files: Sequence[str]) -> list[str]:
    """The warning that ``files`` do not record the opacity compensation of the training; empty if
    all of them are of formats that record it."""
    names = [name for name in files if suffix_of_format(Path(name)) not in RECORDING]
    if not names:
        return []
    return [
        f"{' and '.join(names)} cannot record that the Gaussians were trained with "
        "train.antialias, and viewers without Mip-Splatting's opacity compensation render them too "
        "thick. Enable it in the viewer, use a PLY, SPZ or SOG file, which record it, or train "
        "with train.antialias: false"
    ]
