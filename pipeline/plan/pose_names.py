"""Given poses and photographs belong together by their names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.config.schema import Config
from pipeline.io.folders import PhotoFolder
from pipeline.io.names import LINEAR_SUFFIXES, match_names, stem_key, suffix_of
from pipeline.io.posefiles import GivenPoses
from pipeline.plan.listed_split import Part, listed_split
from pipeline.runtime.errors import UserError


def without_linear_pairs(
    names: Sequence[str], poses: GivenPoses | None, warnings: list[str]
) -> list[str]:
    """If a photograph exists both as RAW or EXR and as another file, keep the former, unless the
    poses name the other one."""
    posed = set(poses.names) if poses is not None else set()
    linear = {stem_key(name): name for name in names if suffix_of(name) in LINEAR_SUFFIXES}
    dropped = set()
    for name in names:
        other = linear.get(stem_key(name))
        if other is not None and suffix_of(name) not in LINEAR_SUFFIXES:
            dropped.add(other if name in posed else name)
    if dropped:
        first = sorted(dropped)[0]
        warnings.append(
            f"{len(dropped)} photographs exist both as RAW or EXR and as another file; one of each "
            f"pair is left out (first: {first})"
        )
    return [name for name in names if name not in dropped]


def check_pose_names(
    folder: Path,
    poses: GivenPoses,
    chosen: PhotoFolder,
    names: Sequence[str],
    warnings: list[str],
) -> None:
    """Check that poses and photographs belong together; warn of those without a counterpart."""
    if poses.format.names == "order":
        if len(chosen.names) != poses.num_images:
            raise UserError(
                f"expected as many poses as photographs, found {poses.num_images} poses and "
                f"{len(chosen.names)} photographs in {chosen.path}/",
                file=folder / poses.path,
                fix="restore the missing photographs, or set poses: ignore",
            )
        return
    prefix = poses.format.prefix(chosen.base)
    photos = match_names(poses.names, [prefix + name for name in names], folder / poses.path)
    matched = set(photos.values())
    missing = [name for name in poses.names if name not in matched]
    if len(missing) == len(poses.names):
        raise UserError(
            f"none of its {len(poses.names)} images is a photograph in "
            f"{folder / chosen.path} (first: {poses.names[0]})"
            if missing
            else "expected camera poses, found none",
            file=folder / poses.path,
            fix="rename the photographs to the names in the pose file, or set poses: ignore",
        )
    if missing:
        warnings.append(
            f"{len(missing)} of {len(poses.names)} poses have no photograph and are left out "
            f"(first: {missing[0]})"
        )
    if poses.lost:
        warnings.append(
            f"{len(poses.lost)} photographs are not used, because their pose is not finite "
            f"(tracking was lost; first: {poses.lost[0]})"
        )
    if len(photos) > len(matched):
        warnings.append(
            f"the poses name no folder: each is used for the {len(photos) // len(matched)} "
            f"photographs of its name in different folders (first: {min(photos)})"
        )
    without = sorted({prefix + name for name in names} - photos.keys())
    if without:
        warnings.append(
            f"{len(without)} of {len(names)} photographs have no given pose and are not used "
            f"(first: {without[0]})"
        )


def split_of(
    poses: GivenPoses | None,
    chosen: PhotoFolder,
    names: Sequence[str],
    config: Config,
    warnings: list[str],
) -> dict[str, Part | None]:
    """Photograph -> its part of the scene's own split; empty where that is not used."""
    if poses is None or not poses.splits or config.split.source == "every":
        return {}
    prefix = poses.format.prefix(chosen.base)
    found = listed_split(poses.splits, [prefix + name for name in names], warnings)
    return {name.removeprefix(prefix): part for name, part in found.items()}
