"""The roles that stages' inputs have, and reading what earlier stages made."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.config.schema import Split, Views
from pipeline.runtime.job import Job
from pipeline.scene.colmap import has_model, read_model
from pipeline.scene.manifest import Manifest
from pipeline.scene.model import Reconstruction, View
from pipeline.scene.views import load_views

if TYPE_CHECKING:
    from pipeline.splats.gaussians import Gaussians

# Stages that can fill a role, the latest in the DAG first.
PHOTOS = ("decode", "inspect")
VIEWS = ("undistort", *PHOTOS)
GIVEN = ("decode", "inspect")
POSES = ("sfm", "refine", *GIVEN)
MODEL = ("undistort", *POSES)

# How Gaussians are drawn outside training.
DRAWING_OPTIONS = ("train.sh_degree", "train.antialias", "train.background")


def read_manifest(job: Job, role: str) -> Manifest:
    return Manifest.read(job.inputs[role] / "images.json")


def input_model(job: Job, role: str = "model") -> Reconstruction:
    return read_model(job.inputs[role] / "sparse" / "0")


def georeference(job: Job) -> dict[str, Any] | None:
    """The frame of the poses (``georeference.json``); None where the stage that gave them recorded
    none."""
    file = job.inputs["poses"] / "georeference.json"
    return read_json(file) if file.is_file() else None


def read_json(file: Path) -> Any:
    return json.loads(file.read_text())


def trained_model(job: Job) -> Reconstruction:
    """The views' model, with its cameras as training refined them (``train.refine_poses``,
    ``train.refine_intrinsics``)."""
    refined = job.inputs["train"] / "sparse" / "0"
    return read_model(refined) if has_model(refined) else input_model(job)


def trained_gaussians(job: Job) -> Gaussians:
    from pipeline.splats.gaussians import Gaussians

    return Gaussians.load(job.inputs["train"] / "gaussians.npz")


def trained_views(job: Job) -> list[View]:
    """All views, with the cameras of ``trained_model``."""
    manifest = read_manifest(job, "views")
    return load_views(manifest, trained_model(job), job.section(Views), job.section(Split))
