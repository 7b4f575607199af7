"""Scanning a scene folder: file names and headers, without decoding pixels.

All facts that the plan depends on are collected here. The Snakefile scans every scene whenever it
builds the DAG, so facts about files are cached.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from pydantic import BaseModel, ConfigDict

from pipeline.config.schema import Config
from pipeline.io.fact_cache import FactCache
from pipeline.io.gcp import ground_control_file
from pipeline.io.gps import fault_warnings
from pipeline.io.photofile import FileFacts
from pipeline.io.posefiles import (
    GivenPoses,
    find_poses,
    incomplete_models,
    other_models,
    pose_files,
    truth_folder,
)
from pipeline.plan.colours import unread_colours
from pipeline.plan.companion_files import depths_of, masks_of, without_companions
from pipeline.plan.depth_maps import check_depth_maps
from pipeline.plan.faults import Faults
from pipeline.plan.fingerprint import cached_digest, digest_of_files, fingerprint_of
from pipeline.plan.given_cameras import check_given
from pipeline.plan.given_poses import GivenFiles
from pipeline.plan.ground_control import GroundControlFile, find_ground_control
from pipeline.plan.inventory import Inventory
from pipeline.plan.listed_split import Part
from pipeline.plan.panoramas import partial_panoramas
from pipeline.plan.photo_folder import choose_photo_folder, read_all, uses_masks
from pipeline.plan.point_cloud import PointCloudFiles, find_point_cloud
from pipeline.plan.pose_names import check_pose_names, split_of, without_linear_pairs
from pipeline.plan.sequence import why_ordered
from pipeline.plan.video_files import find_videos, planned_frames, read_videos
from pipeline.runtime.errors import ChangedFileError, UserError
from pipeline.scene.manifest import Manifest, Photo, VideoFile

_ADD_PHOTOS = (
    "put photographs into images/ inside the scene folder, or a video into the scene folder"
)


class Scan(BaseModel):
    """The content of a scene folder.

    Attributes:
        folder: the scene folder.
        manifest: the photographs and videos that are used; names of photographs are relative to
            ``image_folder``.
        image_folder: relative to ``folder``, "." for itself.
        base_folder: the folder that the given poses refer to ("images" for "images_4").
        image_folder_reason: why it was chosen.
        listed: names of all photographs found, with those left out of the manifest.
        poses: None without given poses, or if they are ignored (``poses: ignore``).
        ordered: the reason to treat the photographs as a sequence, or None.
        ground_control: The scene's ``gcp_list.txt``, if any.
        ground_control_text: A description of the content of ``ground_control``.
        cloud: the point cloud that the Gaussians are initialised from, or None.
        truth, truth_digest: folder and digest of ground truth poses, for evaluation only.
        fingerprint: digest of the names and contents of photographs, videos, masks, depth maps,
            pose files, ground control points and point cloud; independent of times and of the
            folder's location.
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
    cloud: PointCloudFiles | None
    truth: Path | None
    truth_digest: str | None
    fingerprint: str
    ground_control_text: str = ""
    frames: tuple[Photo, ...] = ()
    """Placeholders for the frames that may be chosen of the videos (``with_frames``)."""
    maybe_panoramas: tuple[str, ...] = ()
    """Photographs of which only the aspect ratio is that of a panorama."""
    unused: tuple[str, ...] = ()
    """Warnings of files that are not used (``Inventory``). They change no result."""
    given_extent: float | None = None
    """The extent of the given cameras (``check_given``); None without given poses."""

    def with_frames(self, max_frames: int) -> Scan:
        """The scan with placeholders for up to ``max_frames`` frames of the videos."""
        return self.model_copy(update={"frames": planned_frames(self.videos, max_frames)})

    @property
    def photos(self) -> tuple[Photo, ...]:
        return self.manifest.photos

    @property
    def videos(self) -> tuple[VideoFile, ...]:
        return self.manifest.videos

    @property
    def planned(self) -> tuple[Photo, ...]:
        """The photographs and ``frames``: the plan settles options by their number and size."""
        return (*self.photos, *self.frames)

    @property
    def warnings(self) -> tuple[str, ...]:
        return (*self.unused, *self.manifest.warnings)

    def check_unchanged(self, fingerprint: str, folder: Path) -> None:
        """Compare with the fingerprint of an earlier scan.

        Raises:
            UserError: they differ.
        """
        if self.fingerprint != fingerprint:
            raise ChangedFileError(
                "the scene has changed since snakemake was started",
                file=folder,
                fix="run the same snakemake command again, and leave the scene's files unchanged "
                "while it runs",
            )

    @property
    def num_linear(self) -> int:
        return sum(photo.linear for photo in self.photos)

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
    def num_test(self) -> int:
        """Number of test views of the scene's own split; 0 without one."""
        return sum(photo.split == "test" for photo in self.photos)

    @property
    def num_panoramas(self) -> int:
        return sum(photo.panorama for photo in self.photos)

    @property
    def num_focal(self) -> int:
        return sum(photo.focal_px is not None for photo in self.photos)

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Distinct (width, height), the most frequent first."""
        counts = Counter((photo.width, photo.height) for photo in self.planned)
        return [size for size, _ in sorted(counts.items(), key=lambda item: (-item[1], item[0]))]


def scan(folder: Path, scene: str, config: Config, *, cache: Path | None) -> Scan:
    """Scan a scene folder.

    Args:
        folder: the scene folder: photographs or videos, and optionally poses, masks, depth maps.
        scene: the scene's name.
        config: The configuration. Only ``inspect``, ``views``, ``features``, ``poses``, ``split``,
            ``init.points_file`` and ``sfm.georeference`` are used.
        cache: JSON file that caches facts about files; None for no cache. A file that cannot be
            written is no error.

    Raises:
        UserError: no such folder, too few photographs, malformed pose files, poses of other
            photographs, masks of another size than their photographs, a point cloud that cannot be
            used, folders that cannot be read.
    """
    try:
        return _scan(folder, scene, config, cache)
    except OSError as error:
        raise UserError(
            f"cannot be read: {error.strerror}",
            file=error.filename or folder,
            fix="give yourself the permission to read it, or move it out of the scene folder",
        ) from None


def _scan(folder: Path, scene: str, config: Config, cache: Path | None) -> Scan:
    _check_folder(folder)
    facts_cache = FactCache(cache)
    faults = Faults()
    warnings: list[str] = []
    poses = None
    if config.poses != "ignore":
        with faults.of("poses", "models", "unlisted"):
            poses = find_poses(folder, facts_cache)
        warnings += [*incomplete_models(folder), *other_models(folder, poses)]

    chosen = choose_photo_folder(folder, config, poses, facts_cache, warnings)
    chosen = without_companions(folder, config, chosen, poses, warnings)
    photographs = [folder / chosen.path / name for name in chosen.names]
    facts = read_all(folder, chosen.path, chosen.names, facts_cache, warnings)
    facts = {name: facts[name] for name in without_linear_pairs(sorted(facts), poses, warnings)}
    listed_videos = find_videos(
        folder, chosen.path, recursive=not chosen.names and chosen.path == "."
    )
    found_videos = listed_videos
    if poses is not None and listed_videos:
        warnings.append(
            f"{len(listed_videos)} videos are not used, because poses are given (first: "
            f"{listed_videos[0]}); poses: ignore uses them"
        )
        listed_videos = []
    videos = read_videos(folder, listed_videos, facts, facts_cache, warnings)
    if not videos and len(facts) < max(config.inspect.min_images, 1):
        given = [file] if (file := ground_control_file(folder)) is not None else []
        given += pose_files(folder / poses.path, poses.kind) if poses is not None else []
        named = [*photographs, *given, *(folder / name for name in found_videos), *faults.files]
        ignored = _ignored(config) | faults.kinds
        warnings += Inventory(folder, chosen, poses, named, ignored).unused()
        faults.check(warnings)
        if not facts:
            _no_photographs(folder, [*chosen.names, *listed_videos], warnings)
        raise UserError(
            f"only {len(facts)} readable photographs, at least {config.inspect.min_images} are "
            "needed" + "".join(f"\n  {line}" for line in warnings),
            file=folder / chosen.path,
            fix="add photographs, or lower inspect.min_images",
        )
    posed = poses is not None or bool(faults)
    split: dict[str, Part | None] = {}
    with faults.of("unlisted"):
        if poses is not None:
            check_pose_names(folder, poses, chosen, sorted(facts), warnings)
        split = split_of(poses, chosen, sorted(facts), config, warnings)
    facts = {name: found for name, found in facts.items() if not split or split[name]}

    masks: dict[str, Path] = {}
    depths: dict[str, Path] = {}
    with faults.of("masks"):
        masks = masks_of(folder, config, chosen, facts, facts_cache, warnings)
    with faults.of("depths"):
        depths = depths_of(folder, chosen, facts)
        check_depth_maps(depths, facts, facts_cache)
    photos = [
        _photo(
            folder, chosen.path, name, facts[name], masks.get(name), depths.get(name), facts_cache
        ).model_copy(update={"split": split.get(name)})
        for name in sorted(facts)
    ]
    warnings += unread_colours(facts)
    extent = None
    if not posed:
        warnings += partial_panoramas(facts)
    elif poses is not None and not faults:
        with faults.of("unlisted"):
            extent = check_given(
                GivenFiles(folder / poses.path, poses.kind, tuple(chosen.names), chosen.base),
                photos,
                facts_cache,
            )
    if not posed and config.sfm.georeference != "none":
        warnings += fault_warnings(facts)
    truth = truth_folder(folder)
    control, cloud = GroundControlFile(), None
    with faults.of():
        control = find_ground_control(
            folder, config, photos, warnings, posed=posed, complete=not videos
        )
    with faults.of("clouds"):
        cloud = find_point_cloud(
            folder, config, poses, control.path is not None, facts_cache, warnings
        )
    manifest = Manifest(scene=scene, photos=tuple(photos), videos=videos, warnings=tuple(warnings))
    used = [*photographs, *masks.values(), *depths.values()]
    used += [folder / name for name in found_videos]
    used += pose_files(folder / poses.path, poses.kind) if poses is not None else []
    used += [control.path] if control.path is not None else []
    used += [folder / name for name in cloud.files] if cloud is not None else []
    used += pose_files(truth, "colmap") if truth is not None else []
    ignored = _ignored(config) | faults.kinds
    unused = Inventory(folder, chosen, poses, [*used, *faults.files], ignored).unused()
    faults.check([*unused, *warnings])
    result = Scan(
        folder=folder,
        manifest=manifest,
        image_folder=chosen.path,
        base_folder=chosen.base,
        image_folder_reason=chosen.reason if facts else "no photographs",
        listed=tuple(chosen.names),
        poses=poses,
        ordered=why_ordered(photos, len(videos)),
        ground_control=control.path,
        ground_control_text=control.text,
        cloud=cloud,
        unused=tuple(unused),
        given_extent=extent,
        maybe_panoramas=tuple(n for n in sorted(facts) if facts[n].panorama == "maybe"),
        truth=truth,
        truth_digest=digest_of_files(folder, pose_files(truth, "colmap"), facts_cache)
        if truth
        else None,
        fingerprint=fingerprint_of(
            folder,
            manifest,
            [*sorted(chosen.names), *listed_videos],
            poses,
            control.path,
            [folder / file for file in cloud.files] if cloud else [],
            facts_cache,
        ),
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
    scenes = sorted(path.name for path in root.iterdir() if path.is_dir() and path.name[0] != ".")
    raise UserError(
        "no such scene folder" if not folder.exists() else "expected a scene folder, found a file",
        file=folder,
        fix=f"choose one of the scenes in {root}: {', '.join(scenes) or 'none'}",
    )


def _ignored(config: Config) -> frozenset[str]:
    """The kinds of files that the configuration leaves out."""
    ignored = set()
    if config.poses == "ignore":
        ignored |= {"poses", "models"}
    if not uses_masks(config):
        ignored.add("masks")
    if config.init.points_file == "none":
        ignored.add("clouds")
    return frozenset(ignored)


def _no_photographs(folder: Path, listed: Sequence[str], warnings: Sequence[str]) -> NoReturn:
    details = "".join(f"\n  {line}" for line in warnings)
    if not listed:
        raise UserError(f"no photograph and no video found{details}", file=folder, fix=_ADD_PHOTOS)
    raise UserError(
        f"none of the {len(listed)} photographs and videos can be read{details}",
        file=folder,
        fix="replace the files by intact copies, or convert them to a supported format",
    )


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
        linear=facts.linear,
        alpha=facts.alpha,
        bits=facts.bits,
        orientation=facts.orientation,
        colours=facts.colours,
        mask=str(mask) if mask else None,
        mask_digest=cached_digest(mask, cache) if mask else None,
        depth=str(depth) if depth else None,
        depth_digest=cached_digest(depth, cache) if depth else None,
        focal_px=facts.focal_px,
        camera_group=facts.camera_group,
        panorama=facts.panorama == "full",
        gps=facts.gps,
        taken=facts.taken,
    )
