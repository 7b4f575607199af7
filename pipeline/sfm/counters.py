"""Counters of the stages of structure from motion."""

from __future__ import annotations

from statistics import median
from typing import Literal

from pydantic import BaseModel, Field

from pipeline.runtime.counters import StageCounters
from pipeline.runtime.text import counted
from pipeline.scene.georeference import GeoreferenceSummary
from pipeline.sfm.judge import Evidence, Grade
from pipeline.sfm.uncertainty_file import UncertaintySummary

Mapper = Literal["incremental", "global"]


class FeaturesCounters(StageCounters):
    """Counters of the features stage."""

    counts: dict[str, int] = Field(description="Photograph's name to its number of keypoints.")

    def headline(self) -> str:
        middle = median(self.counts.values()) if self.counts else 0
        return f"a median of {middle:.0f} keypoints in {counted(len(self.counts), 'photograph')}"


class PairsCounters(StageCounters):
    """Counters of the pairs stage."""

    num_pairs: int = Field(ge=0, description="Number of pairs of photographs to match.")

    def headline(self) -> str:
        return f"{counted(self.num_pairs, 'pair')} to match"


class MatchCounters(StageCounters):
    """Counters of a job of the match stage."""

    num_pairs: int = Field(ge=0, description="Number of pairs that the job matched.")
    num_verified: int = Field(ge=0, description="Number of these with a two-view geometry.")

    def headline(self) -> str:
        return f"{self.num_verified} of {counted(self.num_pairs, 'pair')} verified"


class MatchesCounters(StageCounters):
    """Counters of the matches stage."""

    num_pairs: int = Field(ge=0, description="Number of matched pairs of photographs.")
    num_verified: int = Field(ge=0, description="Number of pairs with a two-view geometry.")
    median_inliers: int = Field(ge=0, description="Median number of inliers of the verified pairs.")
    components: list[int] = Field(
        description="Number of photographs in each connected component of the view graph, largest "
        "first."
    )
    isolated: list[str] = Field(
        description="Names of the photographs outside the largest component."
    )
    num_cameras: int = Field(ge=1, description="Number of cameras.")

    def headline(self) -> str:
        verified = f"{self.num_verified} of {counted(self.num_pairs, 'pair')} verified"
        return f"{verified}, with a median of {counted(self.median_inliers, 'inlier')}"


class CameraSummary(BaseModel):
    """One camera of the model."""

    model_config = StageCounters.model_config

    camera_id: int = Field(description="The camera's id in the model.")
    model: str = Field(description="COLMAP's camera model.")
    width: int = Field(description="Width of its images, pixels.")
    height: int = Field(description="Height of its images, pixels.")
    params: list[float] = Field(
        description="Parameters in COLMAP's order; focal lengths and principal point in pixels."
    )
    num_images: int = Field(description="Number of registered images.")
    focal_prior_px: float | None = Field(
        description="Focal length from EXIF, pixels; null where it is unknown."
    )
    focal_uncertainty_percent: float | None = Field(
        description="Standard deviation of the focal length, per cent; null for panoramas and "
        "where `uncertainty` is."
    )


class AttemptRecord(BaseModel):
    """One mapping attempt."""

    model_config = StageCounters.model_config

    mapper: Mapper = Field(description="The mapper.")
    change: str = Field(
        description="Difference from the first attempt in words; empty for the first."
    )
    registered: int = Field(
        ge=0,
        description="Number of photographs in the largest model; 0 without a model.",
    )
    verdict: Grade = Field(description="Quality of the largest model.")
    reasons: list[str] = Field(description="The defects found; empty for a good model.")
    taken: bool = Field(description="Whether the stage uses the model of this attempt.")


class ComponentSummary(BaseModel):
    """A part of the scene whose photographs are placed relative to each other."""

    model_config = StageCounters.model_config

    photographs: list[str] = Field(description="Names of its photographs.")
    num_points: int = Field(ge=0, description="Number of sparse points.")
    mean_reprojection_error_px: float = Field(description="Mean reprojection error, pixels.")
    verdict: Grade = Field(
        description="Quality of the component by itself, whatever its share of the photographs is."
    )
    reasons: list[str] = Field(description="The defects found; empty for a good one.")
    folder: str = Field(
        description="Where its COLMAP model is in the stage's folder: `sparse/0` is used."
    )


class Gap(BaseModel):
    """Two photographs of parts that are not joined, which have more in common than others."""

    model_config = StageCounters.model_config

    placed: str = Field(description="A photograph of the model that is used.")
    other: str = Field(description="A photograph of another component, or one without a pose.")
    component: int | None = Field(description="The component of `other`; null if it is in none.")
    matches: int = Field(ge=0, description="Number of their matches, verified or not.")

    def advice(self) -> str:
        """What to photograph."""
        what = self.other if self.component is None else f"component {self.component}"
        return f"take photographs between {self.placed} and {self.other} to join {what}"


class SfmCounters(StageCounters):
    """Counters of the sfm stage."""

    mapper: Mapper = Field(description="The mapper that produced the model.")
    registered: int = Field(ge=0, description="Number of registered photographs.")
    total: int = Field(ge=0, description="Number of all photographs.")
    not_registered: list[str] = Field(description="Names of the photographs without a pose.")
    mean_reprojection_error_px: float = Field(description="Mean reprojection error, pixels.")
    num_points: int = Field(ge=0, description="Number of sparse points.")
    mean_track_length: float = Field(description="Mean number of observations per point.")
    components: list[ComponentSummary] = Field(
        description="The models that could not be joined; `sfm.component` chooses one by its place."
    )
    gaps: list[Gap] = Field(
        description="What to photograph to join the other components and the photographs without a "
        "pose to the model that is used."
    )
    cameras: list[CameraSummary] = Field(description="The model's cameras.")
    uncertainty: UncertaintySummary | None = Field(
        description="Standard deviations of the poses; `uncertainty.json` has those of each "
        "photograph. null for more than 1000 photographs."
    )
    verdict: Grade = Field(description="Quality of the model; a failed one ends the stage.")
    evidence: Evidence = Field(description="The statistics behind the verdict.")
    attempts: list[AttemptRecord] = Field(description="The mapping attempts, in order.")
    georeference: GeoreferenceSummary = Field(
        description="Method, origin and residuals (metres) of the world's frame; "
        "`georeference.json` has all of it."
    )

    def headline(self) -> str:
        return (
            f"{self.registered} of {counted(self.total, 'photograph')} placed ({self.verdict}), "
            f"{self.mean_reprojection_error_px:.2f} px, {counted(self.num_points, 'point')}"
        )


class RefineCounters(StageCounters):
    """Counters of the refine stage."""

    freed: bool = Field(
        description="Whether camera parameters were freed and the model was adjusted; otherwise "
        "the output is a copy of the given model."
    )
    error_before_px: float = Field(
        description="Mean reprojection error of the given model, pixels."
    )
    error_px: float = Field(description="Mean reprojection error of the output, pixels.")

    def headline(self) -> str:
        if not self.freed:
            return "the given model is kept"
        before, after = self.error_before_px, self.error_px
        return f"reprojection error {before:.2f} px before, {after:.2f} px after"
