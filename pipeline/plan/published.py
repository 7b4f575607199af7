"""``split.source: published``: the options with which papers measure a scene, and the deviations
from that which the plan can tell."""

from __future__ import annotations

from typing import Any

from pipeline.config.schema import Config
from pipeline.plan.protocols import PUBLISHED_SCENES, PublishedScene, benchmark_scene, recognise
from pipeline.plan.scan import Scan
from pipeline.plan.values import Plan
from pipeline.runtime.errors import UserError

# The deviations of stages that change photographs or given poses.
_DEVIATIONS = {
    "sfm": "poses are estimated, not those of the data set",
    "refine": "the given poses are adjusted",
    "undistort": "photographs are undistorted",
}


def published_scene(scan: Scan) -> PublishedScene | None:
    """The published scene that the folder is; None for others."""
    return recognise(scan.folder.name, [photo.name for photo in scan.photos])


def as_published(scan: Scan, config: Config) -> Config:
    """The config with the published options if ``split.source`` asks for them.

    Options with the value "auto" and those of size, masks and test views are replaced.

    Raises:
        UserError: The folder is no scene of a published benchmark.
    """
    if config.split.source != "published":
        return config
    scene = published_scene(scan)
    if scene is None:
        raise UserError(
            f"split.source: published: {_unknown(scan)}",
            file=scan.folder,
            fix="name the folder as the data set does and restore its photographs, or remove "
            "split.source",
        )
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
    scene = published_scene(scan)
    if scene is None:
        return ""
    if config.split.source == "published":
        return f"{scene.title}: measured as published, as configured"
    return f"{scene.title}; split.source: published measures it as papers do"


def planned_deviations(plan: Plan) -> list[str]:
    """The deviations of the plan from the published protocol of its scene, in words."""
    scene = PUBLISHED_SCENES[plan.facts.published_scene or ""]
    found = [text for stage, text in _DEVIATIONS.items() if plan.runs(stage)]
    folder = plan.facts.image_folder
    if scene.image_folder is not None and folder != scene.image_folder:
        found.append(f"photographs of {folder}/, not of {scene.image_folder}/")
    return found


def _unknown(scan: Scan) -> str:
    """The reason why the folder is no published scene."""
    known = PUBLISHED_SCENES.get(benchmark_scene(scan.folder.name))
    if known is None:
        return f"expected a folder named as a scene ({', '.join(PUBLISHED_SCENES)})"
    found = f"found {len(scan.photos)} photographs"
    if known.every is None:
        return f"expected train/r_0 to r_99 and test/ of {known.title} with their poses, {found}"
    counts = " or ".join(map(str, known.photographs))
    return f"expected the {counts} photographs of {known.title}, {found}"
