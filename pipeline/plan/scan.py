"""A cheap look at a scene folder: headers and names, no pixels.

Everything the plan decides on comes from here. The Snakefile calls it for every scene while it
builds its jobs, so facts about files are remembered between calls.
"""

from __future__ import annotations

import hashlib
import posixpath
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path, PurePosixPath

from pydantic import BaseModel, ConfigDict

from pipeline.config.schema import Config
from pipeline.io.fact_cache import FactCache
from pipeline.io.folders import PhotoFolder, companions, pictures_in, relative_folders
from pipeline.io.gcp import GCP_FILE
from pipeline.io.names import RAW_SUFFIXES, NameIndex, stem_key, suffix_of
from pipeline.io.photofile import FileFacts, read_facts
from pipeline.io.posefiles import (
    GivenPoses,
    find_poses,
    incomplete_models,
    pose_files,
    transforms_photos,
    truth_folder,
)
from pipeline.io.recorded import digest_of
from pipeline.plan.protocols import MIP_NERF_360, benchmark_scene
from pipeline.plan.sequence import why_ordered
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest, Photo

_STEPS = ("", "_2", "_4", "_8")
_ADD_PHOTOS = "put the photographs into images/ inside the scene folder"


class Scan(BaseModel):
    """What a scene folder holds.

    ``folder`` is as given. ``image_folder`` is relative to it ("." for itself); photographs'
    names in the manifest are relative to the image folder. ``base_folder`` is the folder the
    given poses name photographs in (images for images_4). ``listed`` holds the names of all
    picture files found, those left out of the manifest among them. ``poses`` is None where no
    poses are given or ``poses: ignore`` is set. ``ordered`` says why the photographs count as
    a sequence. ``ground_control`` is the scene's ``gcp_list.txt``. ``truth`` and
    ``truth_digest`` are ground truth poses, never an input.
    ``fingerprint`` changes with names and contents of photographs, masks, depth maps, pose files
    and ground control points; not with times or places.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    folder: Path
    manifest: Manifest
    image_folder: str
    base_folder: str
    image_folder_reason: str
    listed: tuple[str, ...]
    poses: GivenPoses | None
    ordered: str | None
    ground_control: Path | None
    truth: Path | None
    truth_digest: str | None
    fingerprint: str

    @property
    def photos(self) -> tuple[Photo, ...]:
        return self.manifest.photos

    @property
    def warnings(self) -> tuple[str, ...]:
        return self.manifest.warnings

    def check_unchanged(self, fingerprint: str, folder: Path) -> None:
        """Compare with the fingerprint of an earlier scan of ``folder``.

        Raises:
            UserError: they differ.
        """
        if self.fingerprint != fingerprint:
            raise UserError(
                "the scene has changed since snakemake was started",
                file=folder,
                fix="run the same snakemake command again, and leave the scene's files unchanged "
                "while it runs",
            )

    @property
    def num_raw(self) -> int:
        return sum(photo.raw for photo in self.photos)

    @property
    def num_alpha(self) -> int:
        return sum(photo.alpha for photo in self.photos)

    @property
    def num_masks(self) -> int:
        return sum(photo.mask is not None for photo in self.photos)

    @property
    def num_depths(self) -> int:
        return sum(photo.depth is not None for photo in self.photos)

    @property
    def num_gps(self) -> int:
        return sum(photo.gps is not None for photo in self.photos)

    @property
    def num_focal(self) -> int:
        return sum(photo.focal_px is not None for photo in self.photos)

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Widths and heights, the commonest first."""
        counts = Counter((photo.width, photo.height) for photo in self.photos)
        return [size for size, _ in sorted(counts.items(), key=lambda item: (-item[1], item[0]))]


def scan(folder: Path, scene: str, config: Config, *, cache: Path | None) -> Scan:
    """Look at ``folder``, the scene named ``scene``.

    Args:
        folder: photographs, and whatever comes with them.
        scene: the scene's name.
        config: ``inspect``, ``views`` and ``poses`` matter.
        cache: a JSON file for what was seen, so that the next look is quick; None for no such
            file. One that cannot be written is no error.

    Raises:
        UserError: no such folder, too few photographs, malformed pose files, cameras without
            photographs, masks of another size.
    """
    _check_folder(folder)
    facts_cache = FactCache(cache)
    warnings: list[str] = []
    poses = None
    if config.poses != "ignore":
        poses = find_poses(folder, facts_cache)
        warnings += incomplete_models(folder)

    chosen = _choose_folder(folder, config, poses, facts_cache, warnings)
    facts = _read_all(folder, chosen.path, chosen.names, facts_cache, warnings)
    facts = {name: facts[name] for name in _without_twins(sorted(facts), poses, warnings)}
    if not facts:
        raise UserError("no photograph found", file=folder, fix=_ADD_PHOTOS)
    if len(facts) < config.inspect.min_images:
        raise UserError(
            f"only {len(facts)} readable photographs, at least {config.inspect.min_images} are "
            "needed" + "".join(f"\n  {line}" for line in warnings),
            file=folder / chosen.path,
            fix="add photographs, or lower inspect.min_images",
        )
    if poses is not None:
        _check_posed(folder, poses, chosen, sorted(facts), warnings)

    step = chosen.path[len(chosen.base) :] if chosen.path.startswith(chosen.base) else ""
    masks = _masks(folder, step, config, chosen, facts, facts_cache)
    if masks and len(masks) < len(facts):
        warnings.append(f"{len(facts) - len(masks)} of {len(facts)} photographs have no mask")
    depths = companions(folder, [f"depths{step}", "depths"], sorted(facts))
    photos = [
        _photo(
            folder, chosen.path, name, facts[name], masks.get(name), depths.get(name), facts_cache
        )
        for name in sorted(facts)
    ]
    truth = truth_folder(folder)
    control = folder / GCP_FILE if (folder / GCP_FILE).is_file() else None
    result = Scan(
        folder=folder,
        manifest=Manifest(scene=scene, photos=tuple(photos), warnings=tuple(warnings)),
        image_folder=chosen.path,
        base_folder=chosen.base,
        image_folder_reason=chosen.reason,
        listed=tuple(chosen.names),
        poses=poses,
        ordered=why_ordered(photos),
        ground_control=control,
        truth=truth,
        truth_digest=_digest_files(folder, pose_files(truth), facts_cache) if truth else None,
        fingerprint=_fingerprint(folder, photos, sorted(chosen.names), poses, control, facts_cache),
    )
    facts_cache.save()
    return result


def _check_folder(folder: Path) -> None:
    if folder.is_dir():
        return
    root = folder.parent
    if not root.is_dir():
        raise UserError(
            "this folder of scenes does not exist",
            file=root,
            fix="set data_root to the folder that holds the scene folders",
        )
    there = sorted(path.name for path in root.iterdir() if path.is_dir() and path.name[0] != ".")
    raise UserError(
        "no such scene folder" if not folder.exists() else "expected a scene folder, found a file",
        file=folder,
        fix=f"scenes in {root}: {', '.join(there) or 'none'}",
    )


# --- which photographs --------------------------------------------------------------------


def _choose_folder(
    folder: Path,
    config: Config,
    poses: GivenPoses | None,
    cache: FactCache,
    warnings: list[str],
) -> PhotoFolder:
    wanted = config.inspect.image_folder
    if wanted != "auto":
        wanted = PurePosixPath(wanted).as_posix()
        inside = not wanted.startswith("/") and ".." not in wanted.split("/")
        if not inside or not (folder / wanted).is_dir():
            raise UserError(
                "inspect.image_folder does not name a folder inside the scene folder",
                file=folder / wanted,
                fix=f"choose one of: {', '.join(relative_folders(folder)) or 'none there'}",
            )
    if poses is None or poses.kind == "transforms":
        listed = transforms_photos(folder, warnings if poses is not None else None)
        if listed is not None and wanted in ("auto", listed.path):
            return listed
    if wanted not in ("auto", "."):
        names = pictures_in(folder / wanted, warnings)
        base = "images" if re.fullmatch(r"images_[248]", wanted) else wanted
        return PhotoFolder(wanted, base, "as configured", names)
    sized = [f"images{step}" for step in _STEPS if (folder / f"images{step}").is_dir()]
    if wanted == "auto" and sized:
        return _choose_size(folder, sized, config, poses, cache, warnings)
    return _plain_folder(folder, warnings)


def _plain_folder(folder: Path, warnings: list[str]) -> PhotoFolder:
    """Photographs that lie in the scene folder itself, or in subfolders of any name."""
    top = pictures_in(folder, warnings, recursive=False)
    if top:
        below = [name for name in relative_folders(folder) if pictures_in(folder / name, [])]
        if below:
            warnings.append(
                f"{folder}: photographs lie in the scene folder itself, so those in "
                f"{', '.join(below)} are not used"
            )
        return PhotoFolder(".", ".", "no images/; photographs lie in the scene folder", top)
    names = pictures_in(folder, warnings)
    parents = [posixpath.dirname(name) for name in names]
    base = posixpath.commonpath(parents) if parents else ""
    names = [posixpath.relpath(name, base or ".") for name in names]
    where = f"{base}/" if base else "subfolders"
    return PhotoFolder(base or ".", base or ".", f"no images/; photographs lie in {where}", names)


def _choose_size(
    folder: Path,
    sized: Sequence[str],
    config: Config,
    poses: GivenPoses | None,
    cache: FactCache,
    warnings: list[str],
) -> PhotoFolder:
    """Of images/ and its smaller copies, the smallest that is still large enough; for scenes of
    Mip-NeRF 360 the one that papers use."""
    need = config.views.max_long_side_px
    if poses is None:
        need = max(need, config.features.max_long_side_px)
    found: list[tuple[int, PhotoFolder]] = []
    for path in sized:
        names = pictures_in(folder / path, warnings)
        if names:
            facts = _read_all(folder, path, names[:1], cache, [])
            longest = max((max(f.width, f.height) for f in facts.values()), default=0)
            found.append((longest, PhotoFolder(path, "images", "", names)))
    if not found:
        return PhotoFolder("images", "images", "images/ holds no photograph", [])
    longest, full = found[0]
    usable = [entry for entry in found if _same_photographs(folder, entry[1], full, poses, config)]
    enough = [entry for entry in usable if entry[0] >= need]
    habit = MIP_NERF_360.get(benchmark_scene(folder.name))
    customary = [entry for entry in usable if entry[1].path == habit]
    if customary:
        longest, best = customary[0]
    elif enough:
        longest, best = min(enough, key=lambda entry: entry[0])
    else:
        longest, best = max(usable, key=lambda entry: entry[0])
    others = [f"{entry.path}/ ({size} px)" for size, entry in found if entry is not best]
    reason = f"{best.path}/ ({longest} px long side)"
    if customary:
        reason += f": the copy that papers use of {benchmark_scene(folder.name)} of Mip-NeRF 360"
    elif others:
        is_enough = "the smallest not below" if longest >= need else "the largest; none reaches"
        reason += f": {is_enough} {need} px; others: {', '.join(others)}"
    return PhotoFolder(best.path, "images", reason, best.names)


def _same_photographs(
    folder: Path, other: PhotoFolder, full: PhotoFolder, poses: GivenPoses | None, config: Config
) -> bool:
    """Whether ``other`` can stand for ``full``: nothing that is used gets lost."""
    if other is full:
        return True
    step = other.path[len("images") :]
    for kind in ("masks", "depths"):
        used = kind == "depths" or config.views.masks == "auto"
        if used and (folder / kind).is_dir() and not (folder / f"{kind}{step}").is_dir():
            return False
    if poses is not None and poses.kind == "transforms":
        return False  # Their focal length may refer to the full size without saying so.
    if poses is not None and poses.kind == "llff":
        return len(other.names) == poses.num_images
    wanted = poses.names if poses is not None else full.names
    mine, its = NameIndex(other.names), NameIndex(full.names)
    return all(mine.find(name) for name in wanted if its.find(name))


def _without_twins(
    names: Sequence[str], poses: GivenPoses | None, warnings: list[str]
) -> list[str]:
    """Of a RAW file and a picture of the same name, the RAW file; unless poses name the other."""
    posed = set(poses.names) if poses is not None else set()
    raw = {stem_key(name): name for name in names if suffix_of(name) in RAW_SUFFIXES}
    dropped = set()
    for name in names:
        twin = raw.get(stem_key(name))
        if twin is not None and name != twin and suffix_of(name) not in RAW_SUFFIXES:
            dropped.add(twin if name in posed else name)
    if dropped:
        first = sorted(dropped)[0]
        warnings.append(
            f"{len(dropped)} photographs come both as RAW and as a picture; one of each pair is "
            f"left out (first: {first})"
        )
    return [name for name in names if name not in dropped]


def _read_all(
    folder: Path, image_folder: str, names: Sequence[str], cache: FactCache, warnings: list[str]
) -> dict[str, FileFacts]:
    """Facts of the readable photographs; the others get a warning."""
    facts: dict[str, FileFacts] = {}
    for name in names:
        path = folder / image_folder / name

        def look(path: Path = path) -> dict:
            try:
                return read_facts(path).model_dump()
            except UserError as error:
                return {"unreadable": error.what}

        try:
            seen = cache.get(path, "photo", look)
        except OSError as error:
            seen = {"unreadable": f"cannot be read: {error.strerror}"}
        if "unreadable" in seen:
            warnings.append(f"{path}: left out: {seen['unreadable']}")
        else:
            facts[name] = FileFacts.model_validate(seen)
    return facts


def _check_posed(
    folder: Path,
    poses: GivenPoses,
    chosen: PhotoFolder,
    names: Sequence[str],
    warnings: list[str],
) -> None:
    if poses.kind == "llff":
        if len(chosen.names) != poses.num_images:
            raise UserError(
                f"holds {poses.num_images} poses, but {chosen.path}/ holds {len(chosen.names)} "
                "photographs",
                file=folder / poses.path,
                fix="restore the missing photographs, or set poses: ignore",
            )
        return
    prefix = "" if poses.kind == "colmap" or chosen.base == "." else f"{chosen.base}/"
    index = NameIndex(prefix + name for name in names)
    matched = [index.find(name) for name in poses.names]
    missing = [name for name, match in zip(poses.names, matched, strict=True) if match is None]
    if len(missing) == len(poses.names):
        raise UserError(
            f"none of its {len(poses.names)} cameras has a photograph in "
            f"{folder / chosen.path} (the first one's is {poses.names[0]})"
            if missing
            else "holds no camera poses",
            file=folder / poses.path,
            fix="put the photographs there under the names the poses use, or set poses: ignore",
        )
    if missing:
        warnings.append(
            f"{folder / poses.path}: {len(missing)} of {len(poses.names)} cameras have no "
            f"photograph and are left out (first: {missing[0]})"
        )
    without = sorted({prefix + name for name in names} - {match for match in matched if match})
    if without:
        warnings.append(
            f"{len(without)} of {len(names)} photographs have no given pose and stay unused "
            f"(first: {without[0]})"
        )


# --- what comes with them -----------------------------------------------------------------


def _masks(
    folder: Path,
    step: str,
    config: Config,
    chosen: PhotoFolder,
    facts: Mapping[str, FileFacts],
    cache: FactCache,
) -> dict[str, Path]:
    if config.views.masks == "ignore":
        return {}
    masks = companions(folder, [f"masks{step}", "masks"], sorted(facts))
    for name, listed in chosen.masks.items():
        if name in facts and (folder / listed).is_file():
            masks.setdefault(name, folder / listed)
    for name, path in masks.items():
        mask = _read_mask(path, cache)
        photo = facts[name]
        if (mask.width, mask.height) != (photo.width, photo.height):
            raise UserError(
                f"the mask is {mask.width}x{mask.height}, its photograph {name} is "
                f"{photo.width}x{photo.height} pixels",
                file=path,
                fix="make the mask at the photograph's stored size (EXIF orientation not "
                "applied), or set views.masks: ignore",
            )
    return masks


def _read_mask(path: Path, cache: FactCache) -> FileFacts:
    return FileFacts.model_validate(cache.get(path, "mask", lambda: read_facts(path).model_dump()))


def _photo(
    folder: Path,
    image_folder: str,
    name: str,
    facts: FileFacts,
    mask: Path | None,
    depth: Path | None,
    cache: FactCache,
) -> Photo:
    return Photo(
        name=name,
        path=str(folder / image_folder / name),
        width=facts.width,
        height=facts.height,
        digest=facts.digest,
        raw=facts.raw,
        alpha=facts.alpha,
        bits=facts.bits,
        orientation=facts.orientation,
        mask=str(mask) if mask else None,
        mask_digest=_digest(mask, cache) if mask else None,
        depth=str(depth) if depth else None,
        depth_digest=_digest(depth, cache) if depth else None,
        focal_px=facts.focal_px,
        camera_group=facts.camera_group,
        gps=facts.gps,
        taken=facts.taken,
    )


# --- fingerprint --------------------------------------------------------------------------


def _digest_files(folder: Path, files: Sequence[Path], cache: FactCache) -> str:
    lines = []
    for path in files:
        lines.append(f"{path.relative_to(folder).as_posix()}\0{_digest(path, cache)}")
    return hashlib.blake2b("\n".join(sorted(lines)).encode(), digest_size=16).hexdigest()


def _digest(path: Path, cache: FactCache) -> str:
    return str(cache.get(path, "digest", partial(digest_of, path)))


def _fingerprint(
    folder: Path,
    photos: Sequence[Photo],
    listed: Sequence[str],
    poses: GivenPoses | None,
    control: Path | None,
    cache: FactCache,
) -> str:
    others = [Path(p) for photo in photos for p in (photo.mask, photo.depth) if p is not None]
    if poses is not None:
        others += pose_files(folder / poses.path)
    if control is not None:
        others.append(control)
    lines = [f"{Path(p.path).relative_to(folder).as_posix()}\0{p.digest}" for p in photos]
    # Files that could not be read count by name: a warning names them.
    lines += [*listed, _digest_files(folder, others, cache)]
    return hashlib.blake2b("\n".join(lines).encode(), digest_size=16).hexdigest()
