"""The result of an evaluation (``evaluation.json``)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import Field

from pipeline.metrics.pose import PoseError
from pipeline.plan.protocols import scene_title
from pipeline.runtime.json_file import JsonFile, JsonObject, Vector3, mismatch


class ViewMetrics(JsonObject):
    """One measured view."""

    name: str = Field(description="The photograph's name.")
    psnr: float = Field(description="PSNR, dB.")
    ssim: float = Field(description="SSIM, at most 1.")
    flip: float | None = Field(
        None, description="FLIP, 0 to 1; lower is better. null where it was not measured."
    )
    lpips: float | None = Field(description="null where it was not measured.")
    psnr_without_gains: float | None = Field(
        None, description="PSNR without the view's exposure gains, dB; null where there are none."
    )
    render: str = Field(description="File in `evaluate/renders/`.")


class PublishedProtocol(JsonObject):
    """The published benchmark that a scene is of."""

    benchmark: str = Field(description="Name of the data set.")
    scene: str = Field(description="Name of the scene in it.")
    train_views: int | None = Field(
        None,
        description="Number of training views of papers on few views; null: all that are no test "
        "views.",
    )
    deviations: tuple[str, ...] = Field(
        description="What was done otherwise than papers on 3D Gaussian splatting do with this "
        "scene. Only without any do the measures compare with published ones."
    )

    @property
    def text(self) -> str:
        """In words."""
        title = scene_title(self.scene, self.benchmark, self.train_views)
        if not self.deviations:
            return f"{title}, measured as published"
        return f"{title}, NOT as published: {'; '.join(self.deviations)}"


class ProtocolDescription(JsonObject):
    """How quality was measured; sentences for people."""

    resolution: tuple[str, ...] = Field(
        description="Sizes of the views, `<width>x<height>` in pixels."
    )
    split: str = Field(description="Which views were measured.")
    poses_and_points: str = Field(description="Which photographs they were computed from.")
    num_views: int = Field(ge=1, description="Number of measured views.")
    num_photographs: int | None = Field(
        None,
        description="Number of photographs that the measured views are parts of; null where each "
        "view is a photograph.",
    )
    psnr: str = Field(description="Definition of `psnr`.")
    ssim: str = Field(description="Definition of `ssim`.")
    flip: str | None = Field(None, description="Definition of `flip`; null where not measured.")
    lpips: str = Field(description="Definition of `lpips`, or why it was not measured.")
    masks: str | None = Field(description="Use of masks; null without masks.")
    background: Vector3 = Field(description="RGB in 0..1 behind transparent photographs.")
    exposure: str | None = Field(description="Use of exposure gains; null without gains.")
    appearance: str | None = Field(
        None, description="Fit of appearance to test photographs; null without."
    )
    poses: str | None = Field(description="Adjustment of test cameras; null without.")
    published: PublishedProtocol | None = Field(
        None,
        description="null for scenes of no published benchmark, and for models that `splatmake "
        "evaluate` measures.",
    )


class SceneQuality(JsonObject):
    """Image quality and pose errors of a scene."""

    psnr: float = Field(description="Mean PSNR of the measured views, dB.")
    ssim: float = Field(description="Mean SSIM of the measured views.")
    flip: float | None = Field(
        None,
        description="Mean FLIP of the measured views, 0 to 1; lower is better. null where it was "
        "not measured.",
    )
    lpips: float | None = Field(description="Mean LPIPS; null where it was not measured.")
    lpips_reason: str = Field(description="Why LPIPS was not measured; empty where it was.")
    train_psnr: float | None = Field(
        description="Mean PSNR of a few training views, dB; null without test views. Far above "
        "`psnr`: overfitting. Low itself: inconsistent photographs (moving objects, exposure "
        "changes, wrong poses)."
    )
    psnr_without_gains: float | None = Field(
        description="PSNR without the views' exposure gains; null where there are none."
    )
    psnr_without_fit: float | None = Field(
        None,
        description="PSNR in the scene's own colours, over the same half of each photograph; null "
        "where no appearance is fitted.",
    )
    per_view: tuple[ViewMetrics, ...] = Field(description="In the order of the views' names.")
    protocol: ProtocolDescription = Field(description="How quality was measured.")
    pose_error: PoseError | None = Field(None, description="null without ground truth.")


class EvaluatedModel(JsonObject):
    """The Gaussians that were evaluated."""

    num_gaussians: int = Field(ge=0, description="Number of Gaussians.")
    sh_degree: int = Field(ge=0, le=3, description="Degree of the spherical harmonics.")


class Evaluation(JsonFile, SceneQuality):
    """Renders of a scene's views compared with their photographs."""

    file_name: ClassVar[str] = "evaluation.json"

    schema_version: Literal[1] = Field(1, description="Version of this file's format.")
    model: EvaluatedModel = Field(description="The Gaussians.")
    warnings: tuple[str, ...] = Field(description="What the user should know.")

    @classmethod
    def read_for(cls, folder: Path, views: Iterable[str]) -> Self:
        """Read the evaluation of a scene with these views.

        Raises:
            UserError: the file is missing or damaged, or names a view that the scene lacks.
        """
        evaluation, known = cls.read(folder), set(views)
        unknown = [view.name for view in evaluation.per_view if view.name not in known]
        if unknown:
            what = f"expected measures of views of this scene, found {unknown[0]}, which it lacks"
            raise mismatch(folder / cls.file_name, what)
        return evaluation
