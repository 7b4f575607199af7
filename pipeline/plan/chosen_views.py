"""The photographs of a scene folder that are used: those with a part in the scene's own split, or
the few that ``split.train_views`` chooses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from pipeline.io.folders import PhotoFolder
from pipeline.io.names import compare_names
from pipeline.io.posefiles import GivenPoses
from pipeline.plan.pose_names import Part, check_pose_names, split_of
from pipeline.plan.protocols import PublishedScene, recognise
from pipeline.plan.scene_folder import SceneFolder
from pipeline.runtime.errors import UserError
from pipeline.scene.views import evenly_spaced, is_test_view


class ChosenViews(NamedTuple):
    """The photographs, and which of them are training views and test views.

    Attributes:
        split: The part of each photograph in the scene's own split, or in the choice of
            ``split.train_views``; None for all without either, or if the choice leaves it out.
        published: The published scene that the folder is; None for others.
        few: The plan's sentence about the choice of ``split.train_views``; empty without.
    """

    split: dict[str, Part | None]
    published: PublishedScene | None
    few: str = ""

    @property
    def used(self) -> list[str]:
        """The names of the photographs that are used."""
        return [name for name, part in self.split.items() if part is not None or not self.few]


def choose_views(
    at: SceneFolder, poses: GivenPoses | None, chosen: PhotoFolder, photos: Sequence[str]
) -> ChosenViews:
    """The views of the photographs that have a pose, if any has, and a part in the scene's own
    split, if there is one.

    Args:
        photos: The names of all photographs, sorted.
    """
    own: dict[str, Part | None] = {}
    with at.faults.of("unlisted"):
        if poses is not None:
            check_pose_names(at, poses, chosen, photos)
        own = split_of(at, poses, chosen, photos)
    split = {name: own.get(name) for name in photos if not own or own[name]}
    views = ChosenViews(split, recognise(at.path.name, list(split), at.config.split.train_views))
    if at.config.split.train_views is not None and not at.faults:
        with at.faults.of("unlisted"):
            return _few(at, poses, chosen, views)
    return views


def _few(
    at: SceneFolder, poses: GivenPoses | None, chosen: PhotoFolder, views: ChosenViews
) -> ChosenViews:
    """The choice of ``split.train_views`` among ``views``.

    Raises:
        UserError: There are no given poses, or too few views.
    """
    if poses is None:
        raise UserError(
            "split.train_views: expected given poses, found none: they cannot be estimated from so "
            "few photographs",
            file=at.path,
            fix="give the poses of all photographs (a COLMAP model in sparse/0, transforms.json or "
            "poses_bounds.npy), or remove split.train_views",
        )
    names = _posed(poses, chosen, list(views.split))
    scene = views.published if at.config.split.source == "published" else None
    if scene is not None and scene.training:
        training, test = scene.listed(names)
        how = "those that papers list"
    else:
        test = _test_views(at, names, views.split, scene)
        others = [name for name in names if name not in test]
        wanted = at.config.split.train_views or 0
        if len(others) < wanted:
            raise UserError(
                f"split.train_views: expected at most {len(others)}, the number of views that are "
                f"no test views, found {wanted}",
                file=at.path,
                fix="lower split.train_views, or remove it",
            )
        training, how = set(evenly_spaced(others, wanted)), f"evenly spaced among {len(others)}"
    parts: dict[str, Part] = {name: "test" for name in test}
    parts |= {name: "train" for name in training}
    few = f"{len(training)} training views, {how}, and {len(test)} test views; "
    few += f"{len(views.split) - len(parts)} photographs are not used (split.train_views)"
    return views._replace(split={name: parts.get(name) for name in views.split}, few=few)


def _test_views(
    at: SceneFolder,
    names: Sequence[str],
    own: Mapping[str, Part | None],
    scene: PublishedScene | None,
) -> set[str]:
    """The test views: of the scene's own split, else every n-th; as papers do if ``scene``."""
    if scene is None and any(own.values()):
        return {name for name in names if own[name] == "test"}
    every = at.config.split.test_every if scene is None else scene.every or 0
    return {name for index, name in enumerate(names) if is_test_view(index, every)}


def _posed(poses: GivenPoses, chosen: PhotoFolder, names: Sequence[str]) -> list[str]:
    """The photographs that have a given pose."""
    if poses.format.names == "order":
        return list(names)
    prefix = poses.format.prefix(chosen.base)
    found = compare_names(poses.names, [prefix + name for name in names]).names
    return [name for name in names if prefix + name in found]
