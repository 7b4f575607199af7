"""The choice of the folder whose photographs a scene uses."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from pipeline.io.folders import PhotoFolder, pictures_in, relative_folders
from pipeline.io.names import NameIndex, compare_names
from pipeline.io.photofile import FileFacts, read_facts
from pipeline.io.posefiles import GivenPoses, listed_photos
from pipeline.plan.protocols import recognise
from pipeline.plan.scene_folder import SceneFolder
from pipeline.runtime.errors import UserError

# The suffixes of folders with full-size photographs and with copies at 1/2, 1/4 and 1/8.
_COPY_SUFFIXES = ("", "_2", "_4", "_8")


def choose_photo_folder(at: SceneFolder, poses: GivenPoses | None) -> PhotoFolder:
    """The folder of ``inspect.image_folder``; with "auto" the folder of the photographs that the
    pose files list, else ``images`` or a smaller copy of it, else the scene folder.

    Raises:
        UserError: ``inspect.image_folder`` is not a folder inside ``folder``.
    """
    folder, configured = at.path, at.config.inspect.image_folder
    if configured != "auto":
        configured = PurePosixPath(configured).as_posix()
        inside = not configured.startswith("/") and ".." not in configured.split("/")
        if not inside or not (folder / configured).is_dir():
            raise UserError(
                "expected inspect.image_folder to be a folder inside the scene folder",
                file=folder / configured,
                fix=f"choose one of: {', '.join(relative_folders(folder)) or 'none there'}",
            )
    listed = listed_photos(folder, poses, at.warnings)
    if listed is not None and configured in ("auto", listed.path):
        return listed
    if configured not in ("auto", "."):
        names = pictures_in(folder / configured)
        base = "images" if re.fullmatch(r"images_[248]", configured) else configured
        return PhotoFolder(configured, base, "as configured", names)
    copies = [f"images{suffix}" for suffix in _COPY_SUFFIXES]
    copies = [name for name in copies if (folder / name).is_dir()]
    if configured == "auto" and copies:
        return _choose_copy(at, copies, poses)
    return _scene_folder(folder)


def _scene_folder(folder: Path) -> PhotoFolder:
    """The photographs in the scene folder itself, else those in its subfolders."""
    top = pictures_in(folder, recursive=False)
    if top:
        return PhotoFolder(".", ".", "no images/; photographs are in the scene folder", top)
    names = pictures_in(folder)
    parents = [posixpath.dirname(name) for name in names]
    base = posixpath.commonpath(parents) if parents else ""
    names = [posixpath.relpath(name, base or ".") for name in names]
    where = f"{base}/" if base else "subfolders"
    return PhotoFolder(base or ".", base or ".", f"no images/; photographs are in {where}", names)


def _choose_copy(at: SceneFolder, copies: Sequence[str], poses: GivenPoses | None) -> PhotoFolder:
    """The smallest of images/ and its reduced copies that is not smaller than training and feature
    extraction need; for scenes of Mip-NeRF 360 the copy that papers use."""
    needed = at.config.views.max_long_side_px
    if poses is None:
        needed = max(needed, at.config.features.max_long_side_px)
    found: list[tuple[int, PhotoFolder]] = []
    for path in copies:
        names = pictures_in(at.path / path)
        if names:
            facts = read_all(replace(at, warnings=[]), path, names[:1])
            longest = max((max(f.width, f.height) for f in facts.values()), default=0)
            found.append((longest, PhotoFolder(path, "images", "", names)))
    if not found:
        return PhotoFolder("images", "images", "images/ holds no photograph", [])
    longest, full = found[0]
    usable = [entry for entry in found if _is_complete(at, entry[1], full, poses)]
    large_enough = [entry for entry in usable if entry[0] >= needed]
    published = recognise(at.path.name, full.names, at.config.split.train_views)
    wanted = published.image_folder if published and published.image_folder != "images" else None
    of_papers = [entry for entry in usable if entry[1].path == wanted]
    if of_papers:
        longest, best = of_papers[0]
    elif large_enough:
        longest, best = min(large_enough, key=lambda entry: entry[0])
    else:
        longest, best = max(usable, key=lambda entry: entry[0])
    others = [f"{entry.path}/ ({size} px)" for size, entry in found if entry is not best]
    reason = f"{best.path}/ ({longest} px long side)"
    if published and of_papers:
        reason += f": the copy that papers use for {published.title}"
    elif others:
        rule = "the smallest of at least" if longest >= needed else "the largest; none has"
        reason += f": {rule} {needed} px; others: {', '.join(others)}"
    return PhotoFolder(best.path, "images", reason, best.names)


def _is_complete(
    at: SceneFolder, copy: PhotoFolder, full: PhotoFolder, poses: GivenPoses | None
) -> bool:
    """Whether ``copy`` has all photographs of ``full`` that are used, with masks and depth maps."""
    if copy is full:
        return True
    suffix = copy.path[len("images") :]
    for kind in ("masks", "depths"):
        used = kind == "depths" or at.uses_masks
        if used and (at.path / kind).is_dir() and not (at.path / f"{kind}{suffix}").is_dir():
            return False
    if poses is not None and poses.format.names == "scene":
        return False  # Without w and h, the focal length may refer to the full size.
    if poses is not None and poses.format.names == "order":
        return len(copy.names) == poses.num_images
    needed = compare_names(poses.names, full.names).names if poses is not None else full.names
    in_copy = NameIndex(copy.names)
    return all(in_copy.find(name) for name in needed)


def read_all(at: SceneFolder, image_folder: str, names: Sequence[str]) -> dict[str, FileFacts]:
    """The metadata of each readable photograph by its name; the others add a warning each."""
    facts: dict[str, FileFacts] = {}
    for name in names:
        found = at.cache.read(at.path / image_folder / name, "photo", FileFacts, read_facts)
        if isinstance(found, str):
            at.warnings.append(f"{name}: left out: {found}")
        else:
            facts[name] = found
    return facts
