"""Roles of stages' inputs, and reading the outputs of earlier stages."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.config.schema import Split, Views
from pipeline.config.settled import Train
from pipeline.io.colmap import has_model, read_model
from pipeline.runtime.errors import UserError
from pipeline.runtime.job import Job
from pipeline.scene.background import SceneBackground, with_background
from pipeline.scene.georeference import Georeference
from pipeline.scene.manifest import Manifest
from pipeline.scene.normalization import Normalization
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View, load_views

if TYPE_CHECKING:
    from pipeline.splats.arrays import GaussianArrays
    from pipeline.splats.gaussians import Gaussians
    from pipeline.training.scene import TrainedScene

# The stages that can provide an input, the latest in the DAG first.
PHOTOS = ("decode", "inspect")
VIEWS = ("undistort", *PHOTOS)
GIVEN = ("decode", "inspect")
POSES = ("sfm", "refine", *GIVEN)
MODEL = ("undistort", *POSES)
# Inputs of the stages after training.
TRAINED = {"views": VIEWS, "model": MODEL, "train": ("train",), "poses": POSES}

# The folder with the masks of what training left out of views.
TRANSIENTS = "transients"

# The input of stages after training that read the Gaussians with invented ones, if there are any.
HOLES = {"holes": ("holes",)}

# Roles of stages whose folder has the scene's background, the latest in the DAG first.
BACKGROUND = ("train", "coarse", "init")
# Options that rendering outside of training depends on.
DRAWING_OPTIONS = ("train.device", "train.sh_degree", "train.antialias", "train.background")


def of_jobs(job: Job, role: str) -> list[Path]:
    """The folders of the jobs of the stage with this role, in order; empty if it does not run."""
    count = sum(name.startswith(f"{role}_") for name in job.inputs)
    return [job.inputs[f"{role}_{number}"] for number in range(1, count + 1)]


def read_manifest(job: Job, role: str) -> Manifest:
    return Manifest.read(job.inputs[role] / "images.json")


def input_model(job: Job, role: str = "model", *, points: bool = True) -> Reconstruction:
    return read_model(job.inputs[role] / "sparse" / "0", points=points)


def georeference(job: Job) -> Georeference | None:
    """The frame of the poses, None if their stage has none."""
    folder = job.inputs["poses"]
    return Georeference.read(folder) if (folder / Georeference.file_name).is_file() else None


def normalization(job: Job) -> Normalization:
    """From the world of the given poses to the scene's; the identity for estimated poses."""
    return Georeference.normalization_of(job.inputs["poses"])


def copy_georeference(job: Job, role: str) -> None:
    """Copy the frame of the poses from the input of this role, if it has one."""
    file = job.inputs[role] / Georeference.file_name
    if file.is_file():
        shutil.copy(file, job.out)


def trained_model(job: Job, role: str = "train", *, points: bool = True) -> Reconstruction:
    """The model with cameras as refined by training (``train.refine_poses``,
    ``train.refine_intrinsics``), or by another stage that trains."""
    refined = job.inputs[role] / "sparse" / "0"
    if not has_model(refined):
        return input_model(job, points=points)
    return read_model(refined, points=points)


def drawing(job: Job) -> Train:
    """The options of training, with the background that the stage ``init`` decided on."""
    return with_background(job.section(Train), _background_folder(job))


def copy_background(job: Job) -> None:
    """Copy what ``init`` decided about the background, for later stages."""
    shutil.copy(_background_folder(job) / SceneBackground.file_name, job.out)


def _background_folder(job: Job) -> Path:
    return next(job.inputs[role] for role in BACKGROUND if role in job.inputs)


def write_trained(job: Job, trained: TrainedScene, gaussians: Gaussians | None = None) -> None:
    """Write the outputs of a training, and record what it counted and decided.

    Args:
        gaussians: The Gaussians to write, or None for those that were trained.
    """
    from pipeline.io.appearance_files import write_appearance
    from pipeline.io.colmap import write_model
    from pipeline.io.npz import write_npz
    from pipeline.photos.found_masks import write_found

    found = trained.result.gaussians if gaussians is None else gaussians
    write_npz(job.out / "gaussians.npz", found)
    if trained.model is not None:
        write_model(job.out / "sparse" / "0", trained.model)
    trained.result.curve.write(job.out)
    trained.gains.write(job.out)
    copy_background(job)
    write_found(job.out / TRANSIENTS, trained.result.transients or {})
    if trained.result.appearance is not None:
        write_appearance(job.out, trained.result.appearance)
    job.record(trained.counters, trained.decisions, trained.warnings)
    job.timings = trained.timings


def input_views(job: Job) -> list[View]:
    """All views, with the cameras before training."""
    return _views(job, input_model(job, points=False))


def posed_views(job: Job, refined: Reconstruction | None) -> list[View]:
    """All views, with the cameras of a model that training refined; None: with those before."""
    return input_views(job) if refined is None else _views(job, refined)


def training_views(job: Job) -> list[View]:
    """The views that are not test views, with the cameras before training.

    Raises:
        UserError: there are none.
    """
    found = [view for view in input_views(job) if not view.is_test]
    if not found:
        raise UserError(
            "expected training views, found no photograph with a pose",
            fix="check the photographs' names in the pose file, or set poses: ignore",
        )
    return found


def filled_arrays(job: Job) -> GaussianArrays:
    """The trained Gaussians and the invented ones after them, for stages that do not render."""
    from pipeline.io.npz import read_gaussian_arrays

    folder = job.inputs.get("holes", job.inputs["train"])
    return read_gaussian_arrays(folder / "gaussians.npz")


def trained_gaussians(job: Job) -> Gaussians:
    from pipeline.io.npz import read_npz

    return read_npz(job.inputs["train"] / "gaussians.npz")


def trained_views(job: Job, role: str = "train") -> list[View]:
    """All views, with the cameras of ``trained_model``."""
    return _views(job, trained_model(job, role, points=False))


def _views(job: Job, model: Reconstruction) -> list[View]:
    manifest = read_manifest(job, "views")
    return load_views(manifest, model, job.section(Views), job.section(Split))
