"""Views of a finished scene or of a scene folder, for evaluation outside of the DAG."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from pipeline.config.schema import Config, Split, Train, Views
from pipeline.config.section import MAX_SIDE_PX
from pipeline.io.camera_files import STAGES_WITH_MODEL, results_normalization
from pipeline.io.colmap import read_model
from pipeline.plan.given_poses import load_given
from pipeline.plan.record import read_plan
from pipeline.plan.scan import scan
from pipeline.runtime.errors import UserError
from pipeline.runtime.json_file import first_error, mismatch
from pipeline.runtime.layout import rerun_command
from pipeline.runtime.record import STAGE, read_stage
from pipeline.scene.background import with_background
from pipeline.scene.exposure import NO_GAINS, ExposureGains
from pipeline.scene.manifest import Manifest
from pipeline.scene.normalization import IDENTITY, Normalization
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View, load_views, scene_up

# The stages with photographs, in the order of preference.
_STAGES_WITH_PHOTOS = ("undistort", "decode", "inspect")
# A folder with one of these has results, finished or not.
_RESULTS = ("plan.json", ".scratch")


@dataclass(frozen=True)
class PosedScene:
    """Views with their photographs, and the settings for rendering them.

    Attributes:
        gains: The exposure gains of all views; empty if exposure is not modelled.
        warnings: The warnings of the scan.
        up: (3,) unit vector, the up direction in the world of the views.
        unit: From the unit of exported files, which is that of given poses, to the world of the
            views; the identity if the views are in that unit.
    """

    views: list[View]
    split: Split
    train: Train
    gains: ExposureGains
    warnings: tuple[str, ...]
    up: NDArray[np.float64]
    unit: Normalization


class _Settings(BaseModel):
    """The sections of a training's options that apply to its evaluation."""

    model_config = ConfigDict(frozen=True)

    views: Views
    split: Split
    train: Train


def posed_scene(
    folder: Path, max_long_side: int | None, every: int | None, *, exported: bool = False
) -> PosedScene:
    """The views to evaluate a model on.

    Args:
        folder: A finished scene (``results/NAME``), whose settings apply, or a scene folder with
            given poses.
        max_long_side: The longest side of views in pixels; None for that of the finished scene,
            else that of the photographs.
        every: Every this-many-th view is a test view, none if 0; None for the value of the finished
            scene, else the scene's own split or the default.
        exported: Whether the model is an exported file, in the unit of the given poses. Otherwise
            the views are in the world that the scene was trained in.

    Raises:
        UserError: There is no such scene, it is unfinished or its records are damaged, it has no
            poses, or its cameras have lens distortion.
    """
    if any((folder / name).exists() for name in _RESULTS):
        return _finished(folder, max_long_side, every, exported)
    side = Views(max_long_side_px=max_long_side or MAX_SIDE_PX)
    split = Split() if every is None else Split(source="every", test_every=every)
    found = scan(folder, folder.name, Config(views=side, split=split), cache=None)
    if found.poses is None:
        raise UserError(
            "expected photographs with poses (a COLMAP model in sparse/0, transforms.json or "
            "poses_bounds.npy), found no poses",
            file=folder,
            fix="add them, or give a finished scene's results folder",
        )
    given = load_given(
        folder / found.poses.path,
        found.poses.kind,
        found.photos,
        listed=found.listed,
        base_folder=found.base_folder,
    )
    unit, model = _in_unit(given.normalization, given.model, exported)
    _check_pinhole(model, folder)
    views = load_views(found.manifest, model, side, split)
    train = Train(background="white" if found.num_alpha else "black")
    up = scene_up(views, found.manifest)
    return PosedScene(views, split, train, NO_GAINS, found.warnings, up, unit)


def _finished(
    folder: Path, max_long_side: int | None, every: int | None, exported: bool
) -> PosedScene:
    trained = folder / "train"
    for missing in ("plan.json", f"train/{STAGE}"):
        if not (folder / missing).is_file():
            raise _unfinished(folder, missing)
    try:
        settings = _Settings.model_validate(read_stage(trained).key.get("config"))
    except ValidationError as error:
        what = "expected the settings of a training by this version of the program"
        raise mismatch(trained / STAGE, f"{what} ({first_error(error)})") from None
    views, split = settings.views, settings.split
    if max_long_side is not None:
        views = views.model_copy(update={"max_long_side_px": max_long_side})
    if every is not None:
        split = split.model_copy(
            update={"source": "every", "test_every": every, "train_views": None}
        )
    photos = _output(folder, _STAGES_WITH_PHOTOS, "images.json")
    manifest = Manifest.read(photos)
    model = read_model(_output(folder, STAGES_WITH_MODEL, "sparse/0"), points=False)
    unit, model = _in_unit(results_normalization(folder), model, exported)
    _check_pinhole(model, folder)
    # The paths of photographs may be relative to the folder in which Snakemake ran.
    root = folder.absolute().parent.parent
    found = [
        replace(
            view, image=_resolved(root, view.image), mask=view.mask and _resolved(root, view.mask)
        )
        for view in load_views(manifest, model, views, split)
    ]
    gains = ExposureGains.read_for(trained, [view.name for view in found])
    up = scene_up(found, manifest)
    train = with_background(settings.train, trained)
    return PosedScene(found, split, train, gains, (), up, unit)


def _in_unit(
    normalization: Normalization, model: Reconstruction, exported: bool
) -> tuple[Normalization, Reconstruction]:
    """``PosedScene.unit``, and the model in the unit of exported files if ``exported``."""
    unit = normalization.without_origin()
    return (IDENTITY, unit.model_to_given(model)) if exported else (unit, model)


def _unfinished(folder: Path, missing: str) -> UserError:
    return UserError(
        f"expected a finished scene, found no {missing}: its run has not finished",
        file=folder,
        fix=f"finish it: {rerun_command(folder)}, with the options of that run",
    )


def _output(folder: Path, stages: tuple[str, ...], name: str) -> Path:
    """The output ``name`` of the first of ``stages`` that the scene's plan runs and that has it."""
    plan = read_plan(folder)
    for stage in stages:
        path = folder / stage / name
        if plan.runs(stage) and path.exists():
            return path
    raise _unfinished(folder, " or ".join(f"{stage}/{name}" for stage in stages))


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
