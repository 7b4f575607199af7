"""Given poses and photographs belong together by their names; a scene's own split into training and
test views, which its pose files list by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from pipeline.io.folders import PhotoFolder
from pipeline.io.names import LINEAR_SUFFIXES, compare_names, match_names, stem_key, suffix_of
from pipeline.io.posefiles import GivenPoses
from pipeline.io.poses.frames import ListedSplit
from pipeline.plan.scene_folder import SceneFolder
from pipeline.runtime.errors import UserError

Part = Literal["train", "test"]


def without_linear_pairs(
    at: SceneFolder, names: Sequence[str], poses: GivenPoses | None
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
        at.warnings.append(
            f"{len(dropped)} photographs exist both as RAW or EXR and as another file; one of each "
            f"pair is left out (first: {first})"
        )
    return [name for name in names if name not in dropped]


def check_pose_names(
    at: SceneFolder, poses: GivenPoses, chosen: PhotoFolder, names: Sequence[str]
) -> None:
    """Check that poses and photographs belong together; warn of those without a counterpart."""
    file = at.path / poses.path
    if poses.format.names == "order":
        if len(chosen.names) != poses.num_images:
            raise UserError(
                f"expected as many poses as photographs, found {poses.num_images} poses and "
                f"{len(chosen.names)} photographs in {chosen.path}/",
                file=file,
                fix="restore the missing photographs, or set poses: ignore",
            )
        return
    prefix = poses.format.prefix(chosen.base)
    photos = match_names(poses.names, [prefix + name for name in names], file)
    matched = set(photos.values())
    missing = [name for name in poses.names if name not in matched]
    if len(missing) == len(poses.names):
        raise UserError(
            f"none of its {len(poses.names)} images is a photograph in "
            f"{at.path / chosen.path} (first: {poses.names[0]})"
            if missing
            else "expected camera poses, found none",
            file=file,
            fix="rename the photographs to the names in the pose file, or set poses: ignore",
        )
    if missing:
        at.warnings.append(
            f"{len(missing)} of {len(poses.names)} poses have no photograph and are left out "
            f"(first: {missing[0]})"
        )
    if poses.lost:
        at.warnings.append(
            f"{len(poses.lost)} photographs are not used, because their pose is not finite "
            f"(tracking was lost; first: {poses.lost[0]})"
        )
    if len(photos) > len(matched):
        at.warnings.append(
            f"the poses name no folder: each is used for the {len(photos) // len(matched)} "
            f"photographs of its name in different folders (first: {min(photos)})"
        )
    without = sorted({prefix + name for name in names} - photos.keys())
    if without:
        at.warnings.append(
            f"{len(without)} of {len(names)} photographs have no given pose and are not used "
            f"(first: {without[0]})"
        )


def split_of(
    at: SceneFolder, poses: GivenPoses | None, chosen: PhotoFolder, names: Sequence[str]
) -> dict[str, Part | None]:
    """The part of the scene's own split that each photograph is in; empty if it is not used."""
    if poses is None or not poses.splits or at.config.split.source == "every":
        return {}
    prefix = poses.format.prefix(chosen.base)
    found = _listed_split(poses.splits, [prefix + name for name in names], at.warnings)
    return {name.removeprefix(prefix): part for name, part in found.items()}


def _listed_split(
    splits: Mapping[str, ListedSplit], photos: Sequence[str], warnings: list[str]
) -> dict[str, Part | None]:
    """The part of the split that each photograph is in; None for photographs in neither part.

    Without a list of test views that exist, the validation views are the test views.

    Args:
        splits: The list that each name in the pose files is in; empty without a split.
        photos: The photographs that have a pose, named as in the pose files.
        warnings: The list that warnings are added to.

    Returns:
        The parts by photograph; empty if the scene has no split with training and test views.
    """
    lists = {
        photo: splits.get(name) for photo, name in compare_names(list(splits), photos).names.items()
    }
    found = set(lists.values())
    test: ListedSplit = "test" if "test" in found else "val"
    if not {"train", test} <= found:
        if splits:
            missing = "no training view"
            if "train" in found:
                missing = "no test view beside the training views"
            warnings.append(
                f"the scene's own split is not used, because it lists {missing}: every n-th view "
                "is a test view (split.test_every)"
            )
        return {}
    parts: dict[ListedSplit | None, Part] = {"train": "train", test: "test"}
    result = {photo: parts.get(lists.get(photo)) for photo in photos}
    left_out = sorted(photo for photo, part in result.items() if part is None)
    if left_out:
        warnings.append(
            f"{len(left_out)} photographs are not used, because the scene's own split lists them "
            f"neither for training nor for the test (first: {left_out[0]}); split.source: every "
            "uses them"
        )
    return result
