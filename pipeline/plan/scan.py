"""Scanning a scene folder: file names and headers, without decoding pixels.

All facts that the plan depends on are collected here. The Snakefile scans every scene whenever it
builds the DAG, so facts about files are cached.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NoReturn

from pydantic import BaseModel, ConfigDict

from pipeline.config.schema import Config
from pipeline.io.fact_cache import FactCache
from pipeline.io.folders import PhotoFolder
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
from pipeline.plan.chosen_views import ChosenViews, choose_views
from pipeline.plan.colours import unread_colours
from pipeline.plan.companion_files import depths_of, masks_of, without_companions
from pipeline.plan.given_cameras import check_given
from pipeline.plan.ground_control import GroundControlFile, find_ground_control
from pipeline.plan.inventory import Inventory
from pipeline.plan.panoramas import partial_panoramas
from pipeline.plan.photo_folder import choose_photo_folder, read_all
from pipeline.plan.point_cloud import PointCloudFiles, find_point_cloud
from pipeline.plan.pose_names import without_linear_pairs
from pipeline.plan.scene_folder import SceneFolder, digest_of_text
from pipeline.plan.sequence import why_ordered
from pipeline.plan.video_files import find_videos, planned_frames, read_videos
from pipeline.runtime.errors import ChangedFileError, UserError
from pipeline.runtime.suggest import did_you_mean, nearest, nearest_path
from pipeline.scene.manifest import Manifest, Photo, VideoFile


class Scan(BaseModel):
    """The content of a scene folder.

    Attributes:
        folder: The scene folder.
        manifest: The photographs and videos that are used; the names of photographs are relative to
            ``image_folder``.
        image_folder: The path relative to ``folder``; "." is the scene folder itself.
        base_folder: The folder that the given poses refer to ("images" for "images_4").
        image_folder_reason: The reason why ``image_folder`` was chosen.
        listed: The names of all photographs found, with those left out of the manifest.
        poses: The given poses; None if there are none, or if they are ignored (``poses: ignore``).
        ordered: The reason to treat the photographs as a sequence, or None.
        ground_control: The scene's ``gcp_list.txt``, if any.
        ground_control_text: A description of the content of ``ground_control``.
        cloud: The point cloud that the Gaussians are initialised from, or None.
        truth, truth_digest: The folder and digest of ground truth poses, for evaluation only.
        fingerprint: The digest of the names and contents of photographs, videos, masks, depth maps,
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
    few_views: str = ""
    """The plan's sentence about the choice of ``split.train_views``; empty without."""
    num_unused: int = 0
    """The number of photographs that this choice leaves out."""
    published: str | None = None
    """The title of the published scene that the folder is (``PUBLISHED_SCENES``)."""
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
        """The photographs and ``frames``: the plan settles options by their number and size. Of
        few views (``split.train_views``), the training views."""
        if self.few_views:
            return tuple(photo for photo in self.photos if photo.split != "test")
        return (*self.photos, *self.frames)

    @property
    def warnings(self) -> tuple[str, ...]:
        return (*self.unused, *self.manifest.warnings)

    def check_unchanged(self, fingerprint: str, folder: Path) -> None:
        """Compare with the fingerprint of an earlier scan.

        Raises:
            UserError: The fingerprints differ.
        """
        if self.fingerprint != fingerprint:
            raise ChangedFileError(
                "the scene has changed since this command was started",
                file=folder,
                fix="run the same command again, and leave the scene's files unchanged "
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
        """The number of test views of the scene's own split, or beside ``few_views``; 0 if it has
        neither."""
        return sum(photo.split == "test" for photo in self.photos)

    @property
    def num_panoramas(self) -> int:
        return sum(photo.panorama for photo in self.photos)

    @property
    def num_focal(self) -> int:
        return sum(photo.focal_px is not None for photo in self.photos)

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """The distinct (width, height), with the most frequent first."""
        counts = Counter((photo.width, photo.height) for photo in self.planned)
        return [size for size, _ in sorted(counts.items(), key=lambda item: (-item[1], item[0]))]


def scan(folder: Path, scene: str, config: Config, *, cache: Path | None) -> Scan:
    """Scan a scene folder.

    Args:
        folder: The scene folder: photographs or videos, and optionally poses, masks, depth maps.
        scene: The scene's name.
        config: The configuration. Only ``inspect``, ``views``, ``features``, ``poses``, ``split``,
            ``init.points_file`` and ``sfm.georeference`` are used.
        cache: A JSON file that caches facts about files; None for no cache. A file that cannot be
            written is no error.

    Raises:
        UserError: There is no such folder, it has too few photographs, pose files are malformed or
            of other photographs, a mask has another size than its photograph, a point cloud cannot
            be used, or a folder cannot be read.
    """
    try:
        _check_folder(folder)
        at = SceneFolder(folder, config, FactCache(cache))
        result = _scan(at, scene)
    except OSError as error:
        raise UserError(
            f"cannot be read: {error.strerror}",
            file=error.filename or folder,
            fix="give yourself the permission to read it, or move it out of the scene folder",
        ) from None
    at.cache.save()
    return result


def _scan(at: SceneFolder, scene: str) -> Scan:
    poses = _find_poses(at)
    chosen = without_companions(at, choose_photo_folder(at, poses), poses)
    at.used.extend(at.path / chosen.path / name for name in chosen.names)
    facts = read_all(at, chosen.path, chosen.names)
    facts = {name: facts[name] for name in without_linear_pairs(at, sorted(facts), poses)}
    videos, listed_videos = _find_videos(at, chosen, poses, facts)
    if not videos and len(facts) < max(at.config.inspect.min_images, 1):
        _raise_too_few(at, chosen, poses, len(facts), [*chosen.names, *listed_videos])
    posed = poses is not None or bool(at.faults)
    views = choose_views(at, poses, chosen, sorted(facts))
    photos = _used_photographs(at, chosen, {name: facts[name] for name in views.split}, views)
    facts = {photo.name: facts[photo.name] for photo in photos}
    extent = _check_headers(at, chosen, poses, photos, facts, posed=posed)
    control = GroundControlFile()
    with at.faults.of():
        control = find_ground_control(at, photos, posed=posed, complete=not videos)
    cloud = None
    with at.faults.of("clouds"):
        cloud = find_point_cloud(at, poses, control.path is not None)
    truth = truth_folder(at.path)
    truth_files = pose_files(truth, "colmap") if truth is not None else []
    inputs = at.pose_files(poses)
    inputs += [control.path] if control.path is not None else []
    inputs += [at.path / name for name in cloud.files] if cloud is not None else []
    at.used.extend([*inputs, *truth_files])
    unused = _unused(at, chosen, poses)
    at.faults.check([*unused, *at.warnings])
    manifest = Manifest(
        scene=scene, photos=tuple(photos), videos=videos, warnings=tuple(at.warnings)
    )
    return Scan(
        folder=at.path,
        manifest=manifest,
        image_folder=chosen.path,
        base_folder=chosen.base,
        image_folder_reason=chosen.reason if facts else "no photographs",
        listed=tuple(chosen.names),
        poses=poses.without_points() if poses is not None and views.few else poses,
        ordered=why_ordered(photos, len(videos)),
        ground_control=control.path,
        ground_control_text=control.text,
        cloud=cloud,
        unused=tuple(unused),
        given_extent=extent,
        few_views=views.few,
        num_unused=len(views.split) - len(views.used),
        published=views.published and views.published.title,
        maybe_panoramas=tuple(n for n in sorted(facts) if facts[n].panorama == "maybe"),
        truth=truth,
        truth_digest=at.digest_of_files(truth_files) if truth is not None else None,
        fingerprint=_fingerprint(at, manifest, [*sorted(chosen.names), *listed_videos], inputs),
    )


def _find_poses(at: SceneFolder) -> GivenPoses | None:
    if at.config.poses == "ignore":
        return None
    poses = None
    with at.faults.of("poses", "models", "unlisted"):
        poses = find_poses(at.path, at.cache)
    at.warnings.extend([*incomplete_models(at.path), *other_models(at.path, poses)])
    return poses


def _find_videos(
    at: SceneFolder, chosen: PhotoFolder, poses: GivenPoses | None, photos: Collection[str]
) -> tuple[tuple[VideoFile, ...], list[str]]:
    """The videos that are used, and the names of all that were tried: none if poses are given."""
    recursive = not chosen.names and chosen.path == "."
    names = find_videos(at.path, chosen.path, recursive=recursive)
    at.used.extend(at.path / name for name in names)
    if poses is not None and names:
        at.warnings.append(
            f"{len(names)} videos are not used, because poses are given (first: {names[0]}); "
            "poses: ignore uses them"
        )
        names = []
    return read_videos(at, names, photos), names


def _raise_too_few(
    at: SceneFolder,
    chosen: PhotoFolder,
    poses: GivenPoses | None,
    found: int,
    listed: Sequence[str],
) -> NoReturn:
    """Raises: UserError: there are too few photographs, or an error about a file explains that."""
    control = ground_control_file(at.path)
    at.used.extend([*at.pose_files(poses), *([control] if control is not None else [])])
    warnings = [*at.warnings, *_unused(at, chosen, poses)]
    at.faults.check(warnings)
    details = "".join(f"\n  {line}" for line in warnings)
    if found:
        least = at.config.inspect.min_images
        raise UserError(
            f"only {found} readable photographs, at least {least} are needed{details}",
            file=at.path / chosen.path,
            fix="add photographs, or lower inspect.min_images",
        )
    if not listed:
        raise UserError(
            f"no photograph and no video found{details}",
            file=at.path,
            fix="put photographs into images/ inside the scene folder, or a video into the scene "
            "folder",
        )
    raise UserError(
        f"none of the {len(listed)} photographs and videos can be read{details}",
        file=at.path,
        fix="replace the files by intact copies, or convert them to a supported format",
    )


def _used_photographs(
    at: SceneFolder,
    chosen: PhotoFolder,
    facts: Mapping[str, FileFacts],
    views: ChosenViews,
) -> list[Photo]:
    """The photographs that are used, with their masks, depth maps and parts in the split. Masks and
    depth maps of the others in ``facts`` are no unused files."""
    masks: dict[str, Path] = {}
    depths: dict[str, Path] = {}
    with at.faults.of("masks"):
        masks = masks_of(at, chosen, facts)
    with at.faults.of("depths"):
        depths = depths_of(at, chosen, facts)
    at.used.extend([*masks.values(), *depths.values()])
    shared = Photo.model_fields.keys() - {"panorama"}
    photos = []
    for name in views.used:
        found, mask, depth = facts[name], masks.get(name), depths.get(name)
        photo = Photo(
            **found.model_dump(include=set(shared)),
            name=name,
            path=str(at.path / chosen.path / name),
            mask=str(mask) if mask else None,
            mask_digest=at.digest(mask) if mask else None,
            depth=str(depth) if depth else None,
            depth_digest=at.digest(depth) if depth else None,
            camera_group=found.camera_group,
            panorama=found.panorama == "full",
            split=views.split[name],
        )
        photos.append(photo)
    return photos


def _check_headers(
    at: SceneFolder,
    chosen: PhotoFolder,
    poses: GivenPoses | None,
    photos: Sequence[Photo],
    facts: Mapping[str, FileFacts],
    *,
    posed: bool,
) -> float | None:
    """Compare the photographs' headers with the given cameras, and warn of photographs that are
    used otherwise than their headers say. Returns the extent of the given cameras, if any."""
    at.warnings.extend(unread_colours(facts))
    if not posed:
        at.warnings.extend(partial_panoramas(facts))
        if at.config.sfm.georeference != "none":
            at.warnings.extend(fault_warnings(facts))
    elif poses is not None and not at.faults:
        with at.faults.of("unlisted"):
            return check_given(at, poses, chosen, photos)
    return None


def _unused(at: SceneFolder, chosen: PhotoFolder, poses: GivenPoses | None) -> list[str]:
    """The warnings about unused files, except those that the configuration leaves out."""
    ignored = set(at.faults.kinds)
    if at.config.poses == "ignore":
        ignored |= {"poses", "models"}
    if not at.uses_masks:
        ignored.add("masks")
    if at.config.init.points_file == "none":
        ignored.add("clouds")
    return Inventory(at.path, chosen, poses, [*at.used, *at.faults.files], ignored).unused()


def _fingerprint(
    at: SceneFolder, manifest: Manifest, listed: Sequence[str], inputs: Sequence[Path]
) -> str:
    """The value of ``Scan.fingerprint``.

    Args:
        listed: The names of all photographs and videos. Those that cannot be read are part of the
            fingerprint by their names, because warnings mention them.
        inputs: The files beside the manifest's.
    """
    files: list[Photo | VideoFile] = [*manifest.photos, *manifest.videos]
    others = [Path(p) for photo in manifest.photos for p in (photo.mask, photo.depth) if p]
    lines = [f"{Path(f.path).relative_to(at.path).as_posix()}\0{f.digest}" for f in files]
    lines += [*listed, at.digest_of_files([*others, *inputs])]
    return digest_of_text("\n".join(lines))


def _check_folder(folder: Path) -> None:
    if folder.is_dir():
        return
    root = folder.parent
    if not root.is_dir():
        raise UserError(
            f"this folder of scenes does not exist{did_you_mean(nearest_path(root, folders=True))}",
            file=root,
            fix="set data_root to the folder that holds the scene folders",
        )
    scenes = sorted(path.name for path in root.iterdir() if path.is_dir() and path.name[0] != ".")
    missing = f"no such scene folder{did_you_mean(nearest(folder.name, scenes))}"
    raise UserError(
        missing if not folder.exists() else "expected a scene folder, found a file",
        file=folder,
        fix=f"choose one of the scenes in {root}: {', '.join(scenes) or 'none'}",
    )
