"""What is known of the accuracy of poses and focal lengths (``uncertainty.json``)."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from pipeline.runtime.json_file import JsonFile, JsonObject


class PoseUncertainty(JsonObject):
    """Standard deviations of a photograph's pose, along the axis where they are largest."""

    centre: float = Field(
        ge=0, description="Of the position relative to the whole model, in the model's unit."
    )
    baseline_share: float = Field(
        ge=0,
        description="Of the position relative to the photographs that share the most points, over "
        "the baseline: the median over its points of the distance to the farthest photograph that "
        "observes the point.",
    )
    direction_deg: float = Field(
        ge=0, description="Of the rotation relative to the whole model, degrees."
    )


class UncertaintySummary(JsonObject):
    """Standard deviations of the poses, as shares of the photographs' baselines."""

    median: float = Field(ge=0, description="Median over the photographs.")
    largest: float = Field(ge=0, description="Largest of a photograph.")
    direction_deg: float = Field(ge=0, description="Median of the rotations, degrees.")
    uncertain: list[str] = Field(
        description="Photographs beyond the bound of the verdict, the most uncertain first."
    )


class Uncertainty(JsonFile):
    """The content of ``uncertainty.json``: standard deviations by the covariance of the last bundle
    adjustment. Poses are relative to the similarity that fits all of them best."""

    file_name: ClassVar[str] = "uncertainty.json"

    photographs: dict[str, PoseUncertainty] = Field(description="Photograph's name to its pose's.")
    focal_percent: dict[int, float] = Field(
        description="Camera's id to the standard deviation of its focal length, per cent."
    )

    def summary(self, bound: float) -> UncertaintySummary:
        """The figures for ``stage.json``; ``bound``: the largest share that is not uncertain."""
        shares = {name: pose.baseline_share for name, pose in self.photographs.items()}
        ordered = sorted(shares, key=lambda name: (-shares[name], name))
        directions = sorted(pose.direction_deg for pose in self.photographs.values())
        return UncertaintySummary(
            median=shares[ordered[len(ordered) // 2]],
            largest=shares[ordered[0]],
            direction_deg=directions[len(directions) // 2],
            uncertain=[name for name in ordered if shares[name] > bound],
        )
