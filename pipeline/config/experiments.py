"""Options that only experiments change: the values behind the product's options.

They are validated like all options and described on a reference page of their own. Their sections
mirror those of ``pipeline.config.schema``.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from pipeline.config.section import (
    MAX_FACTOR,
    MAX_STEPS,
    Count,
    GaussianCount,
    LearningRate,
    LossWeight,
    SceneShare,
    Section,
    Share,
    Steps,
    Unit,
)

PartOfRun = Annotated[float, Field(ge=0, lt=1), Unit("share of the steps")]
PartOfGaussians = Annotated[float, Field(ge=0, lt=1), Unit("share of the Gaussians")]
Factor = Annotated[float, Field(gt=0, le=MAX_FACTOR), Unit("factor")]


class InspectExperiments(Section):
    """The photographs that are used."""

    keep_duplicates: bool = Field(
        False,
        description="Keep photographs that show the same as another: copies, reduced copies and "
        "bursts. They are always kept if poses are given.",
    )


class MatchesExperiments(Section):
    """Feature matching."""

    max_ratio: Share = Field(
        0.8, description="Lowe's ratio test: nearest distance over second nearest."
    )
    min_inliers: Annotated[int, Field(gt=0, le=1_000_000), Unit("matches")] = Field(
        15, description="Pairs with fewer verified matches are discarded."
    )


class InitExperiments(Section):
    """The initial Gaussians."""

    opacity: Share = Field(
        0.3, description="Initial opacity (3DGS: 0.1); at most 0.1 for random Gaussians."
    )
    num_random: GaussianCount = Field(
        10_000, description="Number of Gaussians with init.method: random."
    )


class DensityExperiments(Section):
    """The timeline of density control. Intervals shrink in runs of fewer than 7000 steps."""

    start_step: Annotated[int, Field(ge=0, le=MAX_STEPS), Unit("steps")] = Field(
        500, description="First step after which Gaussians are densified."
    )
    stop_share: Annotated[float, Field(ge=0, le=1), Unit("share of the steps")] = Field(
        0.7, description="Densification ends after this share of the run."
    )
    interval: Steps = Field(100, description="Steps between densifications.")
    prune_opacity: Share = Field(0.005, description="Gaussians with a lower opacity are removed.")


class GradientExperiments(DensityExperiments):
    """The strategy ``gradient``."""

    grad_threshold: Annotated[float, Field(ge=0, le=MAX_FACTOR), Unit("per NDC")] = Field(
        1e-5,
        description="Gaussians with a larger mean gradient of their projected centre are split, "
        "the largest gradients first, up to the limit of Gaussians (3DGS: 2e-4).",
    )
    recycle_share: Share = Field(
        0.02,
        description="At the limit of Gaussians: maximum share of it that is removed at each "
        "densification, the most transparent of those with the smallest gradients, to make room "
        "for splits. 0: never.",
    )
    prune_scale: SceneShare = Field(
        0.1,
        description="Gaussians with a larger scale are removed after the first opacity reset.",
    )
    opacity_reset_interval: Steps = Field(
        3000,
        description="Steps between opacity resets. A reset only happens if at least one more "
        "interval of densification follows.",
    )


class McmcExperiments(DensityExperiments):
    """The strategy ``mcmc`` (Kheradmand et al. 2024)."""

    growth_share: Annotated[float, Field(ge=0, le=MAX_FACTOR), Unit("share")] = Field(
        0.05, description="Growth of the number of Gaussians at each densification."
    )
    noise: bool = Field(True, description="Add noise to the means of transparent Gaussians.")
    opacity_loss_weight: LossWeight = Field(
        0.01, description="Weight of the mean opacity in the loss."
    )
    scale_loss_weight: LossWeight = Field(0.01, description="Weight of the mean scale in the loss.")


class TrainExperiments(Section):
    """The optimisation of the Gaussians."""

    coarse_share: PartOfRun | None = Field(
        None,
        description="Share of the run, in steps or minutes, at reduced resolution (1/4, then 1/2). "
        "null: 0.15 of the steps, or 0.1 of budget_minutes but at most 1.2 minutes (3DGS: 0).",
    )
    sh_degree_interval: Steps = Field(
        1000, description="Steps after which the degree of spherical harmonics grows by one."
    )
    squared_error_loss_weight: LossWeight = Field(
        2.5, description="Weight of the squared error, relative to L1 (3DGS: 0)."
    )
    alpha_loss_weight: LossWeight = Field(
        0.15,
        description="Weight of the error of the rendered alpha for images with alpha, relative to "
        "L1 (3DGS: 0).",
    )
    mask_loss_weight: LossWeight = Field(
        0.1,
        description="Weight of the rendered alpha of pixels that a mask excludes, relative to the "
        "colour loss. 0, or background: skybox or fill: no loss on these pixels.",
    )
    clamp_color_gradient: bool = Field(
        False,
        description="No gradient for a colour that is clamped at 0 (3DGS). False: gradients that "
        "raise it pass.",
    )
    appearance_size: Annotated[int, Field(ge=1, le=6), Unit("numbers")] = Field(
        6, description="With train.appearance: embedding: size of a photograph's embedding."
    )
    max_pose_change: Annotated[float, Field(gt=0, lt=1), Unit("radians, scene extents")] = Field(
        0.02,
        description="With train.refine_poses: upper limit of a camera's total rotation and "
        "translation.",
    )
    max_intrinsics_change: Annotated[float, Field(gt=0, lt=1), Unit("focal lengths")] = Field(
        0.02,
        description="With train.refine_intrinsics: upper limit of the total change of focal length "
        "and principal point.",
    )
    adam_beta1: Annotated[float, Field(ge=0, lt=1), Unit("factor")] = Field(
        0.8, description="Adam's decay rate of the first moment (3DGS: 0.9)."
    )
    adam_epsilon: Annotated[float, Field(ge=0, le=MAX_FACTOR), Unit("pixels")] = Field(
        0.03,
        description="Adam's epsilon: Gaussians that change the loss by less than so many pixels do "
        "take smaller steps (3DGS: 0).",
    )
    means_learning_rate_unit: Literal["gaussian_scale", "scene_scale", "camera_extent"] = Field(
        "gaussian_scale",
        description="Unit of means_learning_rate. gaussian_scale: each Gaussian's scales, along "
        "its own axes, about which it also rotates; camera_extent: 1.1 times the largest distance "
        "of a camera from their mean (3DGS); scene_scale: the same, but at most half the median "
        "depth of the sparse points.",
    )
    means_learning_rate: LearningRate = Field(
        0.04, description="Initial learning rate of the means (3DGS: 1.6e-4)."
    )
    means_final_learning_rate: Annotated[float, Field(gt=0, le=MAX_FACTOR), Unit("per step")] = (
        Field(
            4e-3, description="Final learning rate of the means; log-linear decay (3DGS: 1.6e-6)."
        )
    )
    scales_learning_rate: LearningRate = Field(
        5e-3, description="Learning rate of the logarithms of the scales."
    )
    quats_learning_rate: LearningRate = Field(
        2e-3, description="Learning rate of the rotations: half their angle (3DGS: 1e-3)."
    )
    opacities_learning_rate: LearningRate = Field(
        2.5e-2, description="Learning rate of the logits of the opacities (3DGS: 5e-2)."
    )
    sh0_learning_rate: LearningRate = Field(
        2.5e-3, description="Learning rate of the SH coefficients of degree 0."
    )
    shN_learning_rate: LearningRate = Field(
        6e-4, description="Learning rate of the other SH coefficients (3DGS: 1.25e-4)."
    )
    learning_rate_factor: Factor | None = Field(
        None,
        description="Factor of all learning rates. null: sqrt(30000 / steps), between 1 and 4, "
        "or less than 4 if fewer than half of the views see a Gaussian (3DGS: 1).",
    )
    dropout: PartOfGaussians | None = Field(
        None,
        description="Share of the Gaussians that is not drawn in a step, at the end of the run; it "
        "rises from 0. null: 0.2 for up to 26 training views and at least 50 epochs, else 0 "
        "(3DGS: 0); of six views and more, one is held back in the first quarter of the run, and "
        "the share is 0 if it and the others then have a PSNR of 34.",
    )
    views_per_sh_coefficient: Annotated[float, Field(ge=0, le=MAX_FACTOR), Unit("views")] = Field(
        1.0,
        description="The degree of the spherical harmonics is at most that with one coefficient "
        "for so many training views. 0: no such limit (3DGS).",
    )
    learning_rate_decay_start: PartOfRun = Field(
        0.7,
        description="From this point on, all learning rates but that of the means decay "
        "(log-linearly).",
    )
    learning_rate_final_factor: Annotated[float, Field(gt=0, le=1), Unit("factor")] = Field(
        0.1, description="What they have decayed to at the end (3DGS: 1)."
    )
    gradient: GradientExperiments = Field(default_factory=GradientExperiments)
    mcmc: McmcExperiments = Field(default_factory=McmcExperiments)


class ExportExperiments(Section):
    """Exported files."""

    morton_order: bool = Field(
        True,
        description="Sort Gaussians along a Z-order curve (smaller files). False: in the order of "
        "training.",
    )
    min_opacity: Share = Field(0.0, description="Gaussians with a lower opacity are left out.")


class ReportExperiments(Section):
    """The report."""

    views: Count = Field(3, description="Number of views that are shown, from worst to best.")


class Experiments(Section):
    """Options of experiments, by the section that they belong to."""

    inspect: InspectExperiments = Field(default_factory=InspectExperiments)
    matches: MatchesExperiments = Field(default_factory=MatchesExperiments)
    init: InitExperiments = Field(default_factory=InitExperiments)
    train: TrainExperiments = Field(default_factory=TrainExperiments)
    export: ExportExperiments = Field(default_factory=ExportExperiments)
    report: ReportExperiments = Field(default_factory=ReportExperiments)


#: The default values.
DEFAULT = Experiments()
