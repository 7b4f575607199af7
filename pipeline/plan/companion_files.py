"""The masks and depth maps of a scene's photographs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from pipeline.io.companions import (
    DEPTHS,
    MASKS,
    CompanionKind,
    beside_photographs,
    find_companions,
    several_beside,
)
from pipeline.io.folders import PhotoFolder
from pipeline.io.photofile import FileFacts, read_facts
from pipeline.io.posefiles import GivenPoses
from pipeline.plan.depth_maps import check_depth_maps
from pipeline.plan.scene_folder import SceneFolder
from pipeline.runtime.errors import UserError


def without_companions(
    at: SceneFolder, chosen: PhotoFolder, poses: GivenPoses | None
) -> PhotoFolder:
    """The folder's photographs without the masks and depth maps that lie beside them.

    Files that the poses name, or count, are photographs.

    Raises:
        UserError: There are several files of one photograph, and their kind is used.
    """
    if poses is not None and poses.format.names != "photos":
        return chosen
    posed = set(poses.names) if poses is not None else set()
    found: dict[str, dict[str, str]] = {}
    taken: set[str] = set()
    for kind in (MASKS, DEPTHS):
        beside = {
            photo: unposed
            for photo, names in beside_photographs(kind, chosen.names).items()
            if (unposed := [name for name in names if name not in posed])
        }
        error = several_beside(kind, at.path / chosen.path, beside)
        if error is not None and (kind is DEPTHS or at.uses_masks):
            raise error
        found[kind.noun] = {
            photo: (Path(chosen.path) / names[0]).as_posix() for photo, names in beside.items()
        }
        files = {name for names in beside.values() for name in names}
        taken |= files
        if files:
            at.warnings.append(
                f"{len(files)} images beside the photographs are used as {kind.noun}s, for their "
                f"names (first: {min(files)}); rename them if they are photographs"
            )
    names = [name for name in chosen.names if name not in taken]
    return replace(
        chosen,
        names=names,
        masks={**found[MASKS.noun], **chosen.masks},
        depths={**found[DEPTHS.noun], **chosen.depths},
    )


def masks_of(
    at: SceneFolder, chosen: PhotoFolder, facts: Mapping[str, FileFacts]
) -> dict[str, Path]:
    """The mask of each photograph, by the photograph's name.

    Raises:
        UserError: A mask has another size than its photograph, or a name is ambiguous.
    """
    if not at.uses_masks:
        return {}
    masks = _files_of(MASKS, at, chosen, chosen.masks, facts)
    for name, path in masks.items():
        mask = at.cache.get(path, "mask", FileFacts, partial(read_facts, path))
        photo = facts[name]
        if (mask.width, mask.height) != (photo.width, photo.height):
            raise UserError(
                f"the mask is {mask.width}x{mask.height}, its photograph {name} is "
                f"{photo.width}x{photo.height} pixels",
                file=path,
                fix="make the mask at the photograph's stored size (EXIF orientation not "
                "applied), or set views.masks: ignore",
            )
    if masks and len(masks) < len(facts):
        at.warnings.append(f"{len(facts) - len(masks)} of {len(facts)} photographs have no mask")
    return masks


def depths_of(
    at: SceneFolder, chosen: PhotoFolder, facts: Mapping[str, FileFacts]
) -> dict[str, Path]:
    """The depth map of each photograph, by the photograph's name.

    Raises:
        UserError: A name is ambiguous, or a depth map fails ``check_depth_maps``.
    """
    depths = _files_of(DEPTHS, at, chosen, chosen.depths, facts)
    check_depth_maps(depths, facts, at.cache)
    return depths


def _files_of(
    kind: CompanionKind,
    at: SceneFolder,
    chosen: PhotoFolder,
    listed: Mapping[str, str],
    facts: Mapping[str, FileFacts],
) -> dict[str, Path]:
    """The files that ``listed`` names, or that lie beside the photographs; otherwise those in
    folders."""
    copy = chosen.path[len(chosen.base) :] if chosen.path.startswith(chosen.base) else ""
    named = {name: at.path / listed[name] for name in sorted(facts) if name in listed}
    others = [name for name in sorted(facts) if name not in named]
    if not others:
        return named
    return named | find_companions(kind, at.path, kind.places(chosen.path, copy), others)
