"""Views of a finished scene or of a scene folder, for evaluation outside of the DAG."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.config.schema import Config, Split, Train, Views
from pipeline.io.camera_files import STAGES_WITH_MODEL
from pipeline.io.colmap import read_model
from pipeline.plan.given_poses import load_given
from pipeline.plan.record import NAME as PLAN
from pipeline.plan.record import read_plan
from pipeline.plan.scan import scan
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View, load_views

# Stages with photographs, in the order of preference.
_STAGES_WITH_PHOTOS = ("undistort", "decode", "inspect")


@dataclass(frozen=True)
class PosedScene:
    """Views with their photographs, and the settings for rendering them.

    Attributes:
        gains: file of the photographs' exposure gains (``exposure.json``), or None.
        warnings: of the scan.
    """

    views: list[View]
    split: Split
    train: Train
    gains: Path | None
    warnings: tuple[str, ...]


def posed_scene(folder: Path, max_long_side: int | None, every: int | None) -> PosedScene:
    """The views to evaluate a model on.

    Args:
        folder: a finished scene (``results/NAME``), whose settings apply, or a scene folder with
            given poses.
        max_long_side: of views, in pixels; None: as in the finished scene, else that of the
            photographs.
        every: every this-many-th view is a test view, 0: none; None: as in the finished scene,
            else the default.

    Raises:
        UserError: no such scene, damaged records of a finished one, no poses, cameras with lens
            distortion.
    """
    if (folder / PLAN).is_file():
        return _finished(folder, max_long_side, every)
    side = Views(max_long_side_px=max_long_side or 2**31)
    split = Split() if every is None else Split(test_every=every)
    found = scan(folder, folder.name, Config(views=side), cache=None)
    if found.poses is None:
        raise UserError(
            "expected photographs with poses (a COLMAP model in sparse/0, transforms.json or "
            "poses_bounds.npy), found no poses",
            file=folder,
            fix="add them, or give a finished scene's results folder",
        )
    model = load_given(
        folder / found.poses.path,
        found.poses.kind,
        found.photos,
        listed=found.listed,
        base_folder=found.base_folder,
    ).model
    _check_pinhole(model, folder)
    views = load_views(found.manifest, model, side, split)
    train = Train(background="white" if found.num_alpha else "black")
    return PosedScene(views, split, train, None, found.warnings)


def _finished(folder: Path, max_long_side: int | None, every: int | None) -> PosedScene:
    record = folder / "train" / "stage.json"
    try:
        sections = json.loads(record.read_text())["key"]["config"]
        views = Views.model_validate(sections["views"])
        split = Split.model_validate(sections["split"])
        train = Train.model_validate(sections["train"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"expected a finished scene, could not read its settings: {error}",
            file=record,
            fix=f"run snakemake {folder}/metrics.json with this version of the program",
        ) from None
    if max_long_side is not None:
        views = views.model_copy(update={"max_long_side_px": max_long_side})
    if every is not None:
        split = split.model_copy(update={"test_every": every})
    photos = _output(folder, _STAGES_WITH_PHOTOS, "images.json")
    model = read_model(_output(folder, STAGES_WITH_MODEL, "sparse/0"))
    _check_pinhole(model, folder)
    # Paths of photographs may be relative to the folder in which Snakemake ran.
    root = folder.absolute().parent.parent
    found = [
        replace(
            view, image=_resolved(root, view.image), mask=view.mask and _resolved(root, view.mask)
        )
        for view in load_views(Manifest.read(photos), model, views, split)
    ]
    gains = folder / "train" / "exposure.json"
    return PosedScene(found, split, train, gains if gains.is_file() else None, ())


def _output(folder: Path, stages: tuple[str, ...], name: str) -> Path:
    """The output ``name`` of the first of ``stages`` that the scene's plan runs and that has it."""
    plan = read_plan(folder)
    for stage in stages:
        path = folder / stage / name
        if plan.runs(stage) and path.exists():
            return path
    raise UserError(
        f"expected a finished scene, found no {name}",
        file=folder,
        fix=f"run snakemake {folder}/metrics.json",
    )


def _resolved(root: Path, file: str) -> str:
    return file if Path(file).exists() else str(root / file)


def _check_pinhole(model: Reconstruction, source: Path) -> None:
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        if not camera.is_pinhole:
            raise UserError(
                f"{image.name}: expected a pinhole camera, found lens distortion ({camera.model})",
                file=source,
                fix="undistort the photographs first: run the pipeline on them and use its "
                "results folder",
            )
