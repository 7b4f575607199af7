"""``split.source: published``: the options with which papers measure a scene, and the deviations
from that which the plan can tell."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from pipeline.config.schema import Config
from pipeline.config.section import MAX_PHOTOS
from pipeline.plan.protocols import PUBLISHED_SCENES, published_as, scene_title
from pipeline.plan.scan import Scan
from pipeline.plan.values import Plan
from pipeline.runtime.errors import UserError

# The deviations of stages that change photographs or given poses.
_DEVIATIONS = {
    "sfm": "poses are estimated, not those of the data set",
    "refine": "the given poses are adjusted",
    "undistort": "photographs are undistorted",
}


def as_published(scan: Scan, config: Config) -> Config:
    """The config with the published options if ``split.source`` asks for them.

    Options with the value "auto" and those of size, masks and test views are replaced.

    Raises:
        UserError: The folder is no scene of a published benchmark, or papers measure the scene with
            other numbers of training views than ``split.train_views``.
    """
    if config.split.source != "published":
        return config
    scene = PUBLISHED_SCENES.get(scan.published or "")
    if scene is None or scene.train_views != config.split.train_views:
        raise _not_published(scan, config.split.train_views)
    train: dict[str, Any] = {}
    if config.train.background == "auto" and scene.background is not None:
        train["background"] = scene.background
    if config.train.appearance == "measured":
        train["appearance"] = "none"
    changes = {
        "views": config.views.model_copy(
            update={"max_long_side_px": max(scene.size), "masks": "ignore"}
        ),
        "split": config.split.model_copy(
            update={} if scene.every is None else {"test_every": scene.every}
        ),
        "train": config.train.model_copy(update=train),
        "poses": "keep" if config.poses == "auto" else config.poses,
    }
    return config.model_copy(update=changes)


def published_line(scan: Scan, config: Config) -> str:
    """The plan's sentence about the published benchmark; empty for other scenes."""
    if config.split.source == "published":
        return f"{scan.published}: measured as published, as configured"
    scene = PUBLISHED_SCENES.get(scan.published or "")
    if scene is not None and scene.train_views == config.split.train_views:
        return f"{scene.title}; split.source: published measures it as papers do"
    return _numbers_of_papers(scan)


def planned_deviations(plan: Plan) -> list[str]:
    """The deviations of the plan from the published protocol of its scene, in words."""
    scene = PUBLISHED_SCENES[plan.facts.published_scene or ""]
    found = [text for stage, text in _DEVIATIONS.items() if plan.runs(stage)]
    split, folder = plan.config.split, plan.facts.image_folder
    if scene.image_folder is not None and folder != scene.image_folder:
        found.append(f"photographs of {folder}/, not of {scene.image_folder}/")
    if scene.train_views is None:
        return found
    if scene.training and split.source != "published":
        found.append("training and test views are not those that papers list")
    if scene.every is not None and split.test_every != scene.every:
        found.append(f"test views are not every {scene.every}th view")
    if plan.config.init.points_file != "none":
        found.append("Gaussians start from a given point cloud, not from the training views")
    return [*found, scene.deviation] if scene.deviation else found


def _not_published(scan: Scan, train_views: int | None) -> UserError:
    """The error about a scene that no paper measures so."""
    known, found = published_as(scan.folder.name), f"found {len(scan.listed)} photographs"
    fix = "name the folder as the data set does and restore its photographs, or remove split.source"
    if not known:
        names = dict.fromkeys(re.sub(r"\d+", "NUMBER", s.scene) for s in PUBLISHED_SCENES.values())
        expected = f"expected a folder named as a scene ({', '.join(names)})"
    elif numbers := _numbers_of_papers(scan):
        expected = f"{numbers}, found {train_views or 'all'}"
        fix = "set split.train_views to a number that papers use, or remove split.source"
    elif not known[0].photographs:
        title = scene_title(known[0].scene, known[0].benchmark, None)
        expected = f"expected train/r_0 to r_99 and test/ of {title} with their poses, {found}"
    else:
        titles = {scene_title(s.scene, s.benchmark, None): s.photographs for s in known}
        counts = [f"{_either(counts)} photographs of {title}" for title, counts in titles.items()]
        expected = f"expected the {' or the '.join(counts)}, {found}"
    return UserError(f"split.source: published: {expected}", file=scan.folder, fix=fix)


def _numbers_of_papers(scan: Scan) -> str:
    """The numbers of training views with which papers measure the scene; empty for others."""
    known = [scene for scene in published_as(scan.folder.name) if scene.has(scan.listed)]
    if not known:
        return ""
    numbers = sorted(scene.train_views or MAX_PHOTOS for scene in known)
    words = _either("all" if number == MAX_PHOTOS else number for number in numbers)
    title = scene_title(known[0].scene, known[0].benchmark, None)
    return f"{title}: papers use {words} training views (split.train_views)"


def _either(items: Iterable[object]) -> str:
    """The items in words: "3, 6 or 9"."""
    *first, last = map(str, items)
    return f"{', '.join(first)} or {last}" if first else last
