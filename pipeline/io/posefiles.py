"""Finding and summarising the camera poses that a scene folder holds."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path, PurePosixPath

from pydantic import BaseModel, ConfigDict, Field

from pipeline.io.colmap import has_model
from pipeline.io.colmap_models import find_models, model_folders, text_files_beside_binary
from pipeline.io.fact_cache import FactCache
from pipeline.io.folders import PhotoFolder
from pipeline.io.names import PHOTO_SUFFIXES, NameIndex, is_inside, suffix_of
from pipeline.io.poses.formats import (
    FORMATS,
    MIN_IMAGES_PER_CAMERA,
    PoseFormat,
    format_of,
)
from pipeline.io.poses.frames import ListedSplit, PosedFrame
from pipeline.io.poses.kinds import POSE_LABELS, PoseKind
from pipeline.io.recorded import digest_of
from pipeline.io.transforms import read_frames
from pipeline.runtime.errors import UserError

_MODEL_FILES = [(stem, end) for stem in ("cameras", "images") for end in ("bin", "txt")]


class PoseSummary(BaseModel):
    """Summary of the poses in a scene folder."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: PoseKind = Field(description="Kind of the pose files.")
    path: str = Field(
        description="The pose file, or the folder that holds the pose files, relative to the scene "
        "folder; `.` for the scene folder itself."
    )
    num_images: int = Field(description="Number of images with a pose.")
    models: tuple[str, ...] = Field(description="Camera models in use.")
    pinhole: bool = Field(description="Whether no camera has lens distortion.")
    num_points: int = Field(description="Number of sparse points.")
    tracked: int = Field(
        description="Number of observations with known pixels in the image that has the fewest."
    )
    centred: bool = Field(
        description=f"Whether a camera of {MIN_IMAGES_PER_CAMERA} or more images has its principal "
        "point exactly at the image centre, as if it had not been estimated."
    )

    @property
    def label(self) -> str:
        """Kind, place and number of the poses, in words."""
        return f"{POSE_LABELS[self.kind]} {self.source}, {self.num_images} cameras"

    @property
    def source(self) -> str:
        """The pose file or folder, in words."""
        several = self.kind == "transforms" and self.path == "."
        return "transforms*.json" if several else self.path


class GivenPoses(PoseSummary):
    """The poses in a scene folder.

    Attributes:
        names: The photographs' names in the pose files; empty for LLFF, which goes by order.
        lost: The photographs that the pose files list without a pose.
        splits: Name -> the list of the scene's own split that it is in; empty without a split.
    """

    names: tuple[str, ...]
    splits: dict[str, ListedSplit] = {}
    lost: tuple[str, ...] = ()

    def without_points(self) -> GivenPoses:
        """The poses as if the pose files had no sparse points."""
        return self.model_copy(update={"num_points": 0, "tracked": 0})

    @property
    def format(self) -> PoseFormat:
        return format_of(self.kind)


def find_poses(folder: Path, cache: FactCache) -> GivenPoses | None:
    """The poses in a scene folder, of the first of ``FORMATS`` that it has; None without any.

    Raises:
        UserError: the pose files are malformed.
    """
    found = next(_existing_files(folder), None)
    return None if found is None else _summary(folder, *found, cache)


def _existing_files(folder: Path) -> Iterator[tuple[PoseFormat, str]]:
    """The formats of which the scene folder has files, and the paths of these."""
    for entry in FORMATS:
        path = entry.find(folder)
        if path is not None:
            yield entry, path


def incomplete_models(folder: Path) -> list[str]:
    """A warning for each COLMAP folder that has cameras or images but not both."""
    return [
        f"{path}: not used: expected a COLMAP model with cameras and images, found only one of them"
        for path in model_folders(folder)
        if not has_model(folder / path)
        and any((folder / path / f"{stem}.{end}").is_file() for stem, end in _MODEL_FILES)
    ]


def other_models(folder: Path, poses: GivenPoses | None) -> list[str]:
    """Warnings if the scene has COLMAP models beside the one that is used."""
    if poses is None or poses.kind != "colmap":
        return []
    warnings = []
    texts = text_files_beside_binary(folder / poses.path)
    if texts:
        warnings.append(
            f"{poses.path} has binary and text files; the binary ones are used, not "
            f"{', '.join(texts)}"
        )
    models = find_models(folder)
    if len(models) > 1:
        others = ", ".join(model.text for model in models[1:4])
        more = f" and {len(models) - 4} more" if len(models) > 4 else ""
        warnings.append(
            f"of {len(models)} COLMAP models, {models[0].text} is used, which has the most "
            f"photographs of this scene; not used: {others}{more}; remove {poses.path} to use "
            "another"
        )
    return warnings


def other_pose_files(folder: Path, poses: GivenPoses | None) -> list[Path]:
    """The pose files that are not used, because those of ``poses`` come first."""
    used = set(pose_files(folder / poses.path, poses.kind)) if poses is not None else set()
    found: list[Path] = []
    for entry, path in _existing_files(folder):
        if entry.kind != "colmap":
            found += [file for file in entry.files(folder / path) if file not in used]
    return found


def pose_files(path: Path, kind: PoseKind) -> list[Path]:
    """The files that the poses at ``path`` (folder or file) consist of."""
    return format_of(kind).files(path)


def truth_folder(folder: Path) -> Path | None:
    """The folder of ground truth poses, if any. They are for evaluation only, never an input."""
    truth = folder / "sparse_gt"
    return truth if has_model(truth) else None


def listed_photos(
    folder: Path, poses: GivenPoses | None, warnings: list[str]
) -> PhotoFolder | None:
    """The existing photographs that the pose files list, or None if there are none.

    Args:
        poses: The given poses; None if they are not used: then a malformed file is no error, and
            adds no warning.
        warnings: The list that warnings are added to.
    """
    if poses is not None:
        entry, path = poses.format, poses.path
    elif (found := next(_existing_files(folder), None)) is not None:
        entry, path = found
    else:
        return None
    if entry.names != "scene":
        return None
    repeated: list[str] = []
    try:
        frames: Sequence[PosedFrame] = []
        if entry.kind == "transforms":
            frames = read_frames(folder / path, repeated)
        elif entry.frames is not None:
            frames = entry.frames(folder / path)
    except UserError:
        if poses is not None:
            raise
        return None
    name = "transforms*.json" if entry.kind == "transforms" else path
    warnings = warnings if poses is not None else []
    return _existing(folder, frames, name, repeated, warnings)


def _existing(
    folder: Path,
    listed: Sequence[PosedFrame],
    source: str,
    repeated: list[str],
    warnings: list[str],
) -> PhotoFolder | None:
    frames = {frame.name: frame for frame in listed}
    parents = sorted({str(PurePosixPath(name).parent) for name in frames})
    existing = [
        str(PurePosixPath(parent) / name)
        for parent in parents
        if is_inside(parent) and (folder / parent).is_dir()
        for name in os.listdir(folder / parent)
        if suffix_of(name) in PHOTO_SUFFIXES and name[0] != "."
    ]
    index = NameIndex(existing)
    # All that a name may mean: the names are compared again without unused files of pairs.
    found = {match: frame for name, frame in frames.items() for match in index.equal(name)[1]}
    if not found:
        return None
    base = os.path.commonpath([os.path.dirname(name) or "." for name in found]) or "."
    relative = {os.path.relpath(name, base): frame for name, frame in found.items()}
    masks, lost = _named_files(folder, {name: f.mask for name, f in relative.items()})
    warnings += _frame_warnings(source, repeated, "masks", lost)
    depths, lost = _named_files(folder, {name: f.depth for name, f in relative.items()})
    warnings += _frame_warnings(source, [], "depth maps", lost)
    reason = f"the photographs that {source} lists"
    return PhotoFolder(base, base, reason, sorted(relative), masks, depths)


def _named_files(folder: Path, named: Mapping[str, str | None]) -> tuple[dict[str, str], list[str]]:
    """Photograph -> its mask or depth map that the pose file names; the names that are missing,
    or outside of the scene folder."""
    found: dict[str, str] = {}
    lost: list[str] = []
    for photo, name in named.items():
        if name is None:
            continue
        names = [name, f"{name}.png"] if is_inside(name) else []
        file = next((n for n in names if (folder / n).is_file()), None)
        if file is None:
            lost.append(name)
        else:
            found[photo] = file
    return found, sorted(lost)


def _frame_warnings(source: str, repeated: list[str], noun: str, lost: list[str]) -> list[str]:
    warnings = []
    if repeated:
        warnings.append(
            f"{len(repeated)} frames of {source} name the file of an earlier frame and are "
            f"left out (first: {repeated[0]})"
        )
    if lost:
        warnings.append(
            f"{len(lost)} {noun} that {source} lists are not used: they are missing, "
            f"or outside of the scene folder (first: {lost[0]})"
        )
    return warnings


def _summary(folder: Path, entry: PoseFormat, path: str, cache: FactCache) -> GivenPoses:
    """Summarise the poses; cached by the files' digests, because large models take seconds."""
    digests = [
        [str(file), cache.get(file, "digest", str, partial(digest_of, file))]
        for file in entry.files(folder / path)
    ]
    return cache.get_for_state(
        f"poses:{entry.kind}:{folder / path}",
        digests,
        GivenPoses,
        lambda: GivenPoses.model_validate(
            {"kind": entry.kind, "path": path, **entry.summarise(folder / path)}
        ),
    )
