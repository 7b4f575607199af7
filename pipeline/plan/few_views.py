"""``split.train_views``: the few photographs that a scene is trained on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from pipeline.io.folders import PhotoFolder
from pipeline.io.names import compare_names
from pipeline.io.posefiles import GivenPoses
from pipeline.plan.pose_names import Part
from pipeline.plan.protocols import PublishedScene
from pipeline.plan.scene_folder import SceneFolder
from pipeline.runtime.errors import UserError
from pipeline.scene.views import evenly_spaced, is_test_view


class FewViews(NamedTuple):
    """The choice of training and test views.

    Attributes:
        split: The part of each photograph; None if it is not used.
        text: The plan's sentence about the choice; empty if all views are used.
        num_unused: The number of photographs that are not used.
    """

    split: dict[str, Part | None]
    text: str = ""
    num_unused: int = 0


def choose_few(
    at: SceneFolder,
    poses: GivenPoses | None,
    chosen: PhotoFolder,
    own: Mapping[str, Part | None],
    published: PublishedScene | None,
) -> FewViews:
    """Choose ``split.train_views`` training views among those that are no test views.

    Args:
        own: The photographs, and their part in the scene's own split; all None without one.
        published: The published scene that the folder is.

    Raises:
        UserError: There are no given poses, or fewer views than ``split.train_views``.
    """
    if poses is None:
        raise UserError(
            "split.train_views: expected given poses, found none: they cannot be estimated from so "
            "few photographs",
            file=at.path,
            fix="give the poses of all photographs (a COLMAP model in sparse/0, transforms.json or "
            "poses_bounds.npy), or remove split.train_views",
        )
    split, wanted = at.config.split, at.config.split.train_views or 0
    scene = published if split.source == "published" else None
    names = _posed(poses, chosen, sorted(own))
    if scene is not None and scene.training:
        training, test = scene.listed(names)
        how = "those that papers list"
    else:
        every = split.test_every if scene is None else scene.every or 0
        listed = scene is None and any(own.values())
        test = {
            name
            for index, name in enumerate(names)
            if (own[name] == "test" if listed else is_test_view(index, every))
        }
        others = [name for name in names if name not in test]
        if len(others) < wanted:
            raise UserError(
                f"split.train_views: expected at most {len(others)}, the number of views that are "
                f"no test views, found {wanted}",
                file=at.path,
                fix="lower it, or remove it",
            )
        training, how = set(evenly_spaced(others, wanted)), f"evenly spaced among {len(others)}"
    parts: dict[str, Part] = {name: "test" for name in test}
    parts |= {name: "train" for name in training}
    unused = len(own) - len(parts)
    text = f"{len(training)} training views, {how}, and {len(test)} test views; {unused} "
    text += "photographs are not used (split.train_views)"
    return FewViews({name: parts.get(name) for name in own}, text, unused)


def _posed(poses: GivenPoses, chosen: PhotoFolder, names: Sequence[str]) -> list[str]:
    """The photographs that have a given pose."""
    if poses.format.names == "order":
        return list(names)
    prefix = poses.format.prefix(chosen.base)
    found = compare_names(poses.names, [prefix + name for name in names]).names
    return [name for name in names if prefix + name in found]
