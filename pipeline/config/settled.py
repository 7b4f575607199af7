"""Settled options: the plan has replaced each "auto" by a value.

The stages read these types. Sections without an entry here have no option that is settled. The
defaults serve callers of the library.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from pipeline.config import schema
from pipeline.config.experiments import TrainExperiments
from pipeline.config.section import MAX_PHOTOS, LossWeight

CameraModel = Literal[
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "EQUIRECTANGULAR",
]
Background = Literal["measured", "skybox", "fill", "black", "white", "random"]
Device = Annotated[str, Field(pattern=r"^(cpu|gpu(:[0-9]{1,3})?)$")]


class Features(schema.Features):
    """SIFT features."""

    photos_per_job: Annotated[int, Field(gt=0, le=MAX_PHOTOS)] = Field(
        MAX_PHOTOS, json_schema_extra={"decides_result": False}
    )


class Matches(schema.Matches):
    """Image pairs and their geometric verification."""

    pairs: Literal["exhaustive", "sequential", "spatial", "retrieval"] = "exhaustive"


class Sfm(schema.Sfm):
    """Structure from motion: camera poses and sparse points."""

    mapper: Literal["incremental", "global"] = "incremental"
    camera_model: CameraModel = "SIMPLE_RADIAL"
    share_cameras: Literal["single", "group", "folder", "image"] = "group"
    georeference: Literal["gps", "gcp", "none"] = "none"


class Init(schema.Init):
    """The initial Gaussians."""

    method: Literal["points", "random", "dense"] = "points"


class Partition(schema.Partition):
    """Division of large scenes into blocks that are trained in jobs of their own."""

    blocks: Annotated[int, Field(gt=0, le=schema.MAX_BLOCKS)] = 1


class Train(schema.Train):
    """The optimisation of the Gaussians."""

    device: Device = "cpu"
    background: Background = "black"
    appearance: Literal["measured", "none", "exposure", "embedding"] = "none"
    transients: Literal["find", "none"] = "none"
    depth_loss_weight: LossWeight = 0.0


class TrainOptions(Train):
    """The options of the optimisation, with those of experiments."""

    experiments: TrainExperiments = Field(default_factory=TrainExperiments)


class Config(schema.Config):
    """All options of a scene."""

    features: Features = Field(default_factory=Features)
    matches: Matches = Field(default_factory=Matches)
    sfm: Sfm = Field(default_factory=Sfm)
    init: Init = Field(default_factory=Init)
    partition: Partition = Field(default_factory=Partition)
    train: Train = Field(default_factory=Train)
