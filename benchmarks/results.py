"""Results of the benchmarks, as printed and stored in records.

The SfM benchmark's are in ``benchmarks.sfm.summary``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from benchmarks.judge.truth import Grade, Truth

# ---- benchmarks.georeference ----

GEOREFERENCE_VERDICTS = ("right", "refused", "stated", "warned", "silently wrong")


@dataclass(frozen=True)
class GeoreferenceResult:
    """What the program made of a case.

    Attributes:
        verdict: One of ``GEOREFERENCE_VERDICTS``.
        said: The messages to the user.
        errors: The relative error of the scale, the angle of the frame's rotation in degrees, and
            the largest horizontal and vertical errors of cameras, metres; None without a frame.
    """

    case: str
    seed: int
    verdict: str
    said: str
    errors: tuple[float, float, float, float] | None


# ---- benchmarks.mesh ----


@dataclass(frozen=True)
class Accuracy:
    """One region of the scene.

    Attributes:
        size: the region's, metres.
        median, p90: distances of the mesh from the true surface, by area, shares of ``size``.
        completeness: share of the true surface that has mesh within 1 % of ``size``.
    """

    size: float
    median: float
    p90: float
    completeness: float


@dataclass(frozen=True)
class MeshResult:
    """Attributes:
    voxel_m: side of a voxel, metres.
    seconds: ``wall`` and ``cpu`` time of depth maps and mesh.
    peak_mb: peak memory of the process, MiB.
    foreground, room: see ``benchmarks.surface.measure``.
    """

    triangles: int
    voxel_m: float
    voxels: int
    seconds: dict[str, float]
    peak_mb: float
    foreground: Accuracy
    room: Accuracy


# ---- benchmarks.dense ----


@dataclass(frozen=True)
class DenseResult:
    """Depth maps of a scene; shares are of its textured pixels.

    Attributes:
        pixels: size of the views.
        median_error: median relative error of the pixels with a depth.
        within: share with a relative error below 0.5 %, 1 % and 2 %.
        completeness: share with a depth.
        within_known: as ``within``, of the pixels with a depth.
        points: number of points of the fused cloud.
        instruction_set: of the kernel.
        cpu_s_per_photograph: of all passes.
        peak_mb: peak memory of the process, MiB.
    """

    scene: str
    photographs: int
    pixels: str
    median_error: float
    within: list[float]
    completeness: float
    within_known: list[float]
    points: int
    instruction_set: str
    cpu_s_per_photograph: float
    peak_mb: float


# ---- benchmarks.coverage ----

Place = list[float]
"""Distance of a viewpoint from the nearest removed camera, metres, and the angle between their
viewing directions, degrees."""


@dataclass(frozen=True)
class CoverageResult:
    """One case. Keys ``test`` and ``removed`` are the test views and the removed views.

    Attributes:
        trust: mean trust. psnr: mean PSNR before a photograph is added, dB.
        rank_correlation: of trust and squared error over blocks of all these views.
        first, best_of_five: of the proposals. random_first, random_best_of_five: medians of random
            draws from the candidates.
        better_than_random: share of the random draws whose first viewpoint is farther.
        added_first, added_random: gain in mean PSNR, dB, from a photograph at the first proposal,
            and at the first viewpoint of each random draw.
        surroundings: mean trust of the candidates before and after the proposals, and their number.
    """

    case: str
    training_views: int
    trust: dict[str, float]
    psnr: dict[str, float]
    rank_correlation: float
    first: Place
    best_of_five: Place
    random_first: Place
    random_best_of_five: Place
    better_than_random: float
    added_first: dict[str, float]
    added_random: list[dict[str, float]]
    surroundings: list[float]


# ---- benchmarks.memory ----


@dataclass(frozen=True)
class MemoryResult:
    """Attributes:
    gaussians, most_gaussians: their number at the end, and the largest during training.
    width, height: of each view, pixels.
    checkpoints_mb: size of the checkpoints, MB.
    planned_mb, peak_mb: the plan's estimate and the measured peak, MB.
    """

    gaussians: int
    most_gaussians: int
    views: int
    width: int
    height: int
    seconds_a_step: float
    checkpoints_mb: int
    planned_mb: int
    peak_mb: int


# ---- benchmarks.sfm.growth ----


@dataclass(frozen=True)
class GrowthResult:
    """Attributes:
    cpu_s, peak_mb: of mapping alone; the memory in MiB.
    power: exponent of the time's growth since the last number of views; None for the first.
    registered: images with a pose.
    rotation_deg, centre_m: median errors.
    """

    mapper: str
    views: int
    cpu_s: float
    power: float | None
    peak_mb: float
    registered: int
    rotation_deg: float | None
    centre_m: float | None


# ---- benchmarks.judge ----


@dataclass(frozen=True)
class JudgeResult:
    """Result of a case; ``truth`` is None without ground truth."""

    case: str
    seed: int
    truth: Truth | None
    verdict: Grade
    reasons: list[str]
    registered: int
    total: int
    attempts: int
    cpu_s: float
    evidence: dict[str, float | None] = field(default_factory=dict)

    @property
    def wrong(self) -> bool:
        """Whether a good model was called failed, or a failed one good."""
        return self.truth is not None and {self.truth.grade, self.verdict} == {"good", "failed"}


# ---- benchmarks.stability ----


@dataclass(frozen=True)
class StabilityResult:
    """Outcome of a case.

    Attributes:
        what: the case in words.
        code: Snakemake's exit code.
        psnr, ssim: of test views; None if the run failed.
        reference: the case whose quality it should have, if any.
        difference_db: PSNR minus that of the reference; None where either is unknown.
        gaussians: final number.
        message: of the error, or the warnings of the result.
        traceback: whether a traceback was printed.
        right: whether the outcome is the expected one.
    """

    case: str
    what: str
    code: int
    psnr: float | None
    ssim: float | None
    reference: str | None
    difference_db: float | None
    gaussians: int | None
    message: str
    traceback: bool
    right: bool


# ---- benchmarks.page ----


@dataclass(frozen=True)
class PageResult:
    """One view: PSNR between the viewer's render of ``file`` and the rasterizer's, dB."""

    file: str
    view: str
    psnr: float


# ---- benchmarks.raster_stress ----


@dataclass(frozen=True)
class StressResult:
    """A family of inputs.

    Attributes:
        cases, drawn, dropped: numbers of Gaussians.
        not_finite: number of values of images and gradients that are not finite.
        colour: see ``benchmarks.raster_stress.Tally``.
        gradient_median, gradient_p99, gradient_worst: relative errors over calls.
    """

    family: str
    cases: int
    drawn: int
    dropped: int
    not_finite: int
    colour: float
    gradient_median: float
    gradient_p99: float
    gradient_worst: float


# ---- benchmarks.gpu ----


@dataclass(frozen=True)
class GpuResult:
    """A scene on a GPU, and on the processor of the same machine.

    Attributes:
        phase_ms: time of the kernels of each phase of a training step, by the device's timestamps.
        step_ms, cpu_step_ms: wall time of a step.
        frames_per_s, cpu_frames_per_s: of rendering alone, with the copy of the image.
        bandwidth: bytes per second that copies inside the device's memory read and write.
        moments_bandwidth: bytes of SH coefficients and moments over the time of the kernel that
            updates them.
    """

    device: str
    driver: str
    scene: str
    gaussians: int
    width: int
    height: int
    phase_ms: dict[str, float]
    step_ms: float
    cpu_step_ms: float
    frames_per_s: float
    cpu_frames_per_s: float
    bandwidth: float
    moments_bandwidth: float


# ---- benchmarks.video ----


@dataclass(frozen=True)
class VideoFrames:
    """The choice of frames of a video.

    Attributes:
        frames, chosen: numbers of frames of the video, and of those chosen.
        chosen_sharpness, even_sharpness: medians of the variance of the Laplacian at full
            resolution, of the chosen frames and of as many evenly spaced ones.
    """

    video: str
    frames: int
    chosen: int
    chosen_sharpness: float
    even_sharpness: float


# ---- benchmarks.blocks ----


@dataclass(frozen=True)
class BlocksResult:
    """A scene as one block, and in blocks; pairs are in this order.

    Attributes:
        run: name of the run as one block.
        seed: of both.
        pixels: width and height of a view.
        psnr, ssim: of the test views.
        gaussians: numbers of trained Gaussians.
        training_rss_mb: largest memory of a job of training, MiB.
        peak_rss_mb: largest memory of any job, MiB.
        training_cpu_s: CPU seconds of all training jobs.
        largest_block_cpu_s: of the block that takes longest.
        seam_gradient: mean gradient of the error images of the test views across the seams of the
            blocks, divided by that elsewhere. The first run has no seams: its value is that of
            what the photographs show there.
    """

    run: str
    seed: int | None
    photographs: int
    pixels: str
    test_views: int
    blocks: int
    psnr: tuple[float, float]
    ssim: tuple[float, float]
    gaussians: tuple[int, int]
    training_rss_mb: tuple[float, float]
    peak_rss_mb: tuple[float, float]
    training_cpu_s: tuple[float, float]
    largest_block_cpu_s: float
    seam_gradient: tuple[float, float]

    @property
    def seams(self) -> float:
        """The gradient across seams in blocks over that of the run as one block there."""
        return self.seam_gradient[1] / self.seam_gradient[0]


# ---- benchmarks.scaling ----


@dataclass(frozen=True)
class ScalingResult:
    """A stage of a run, or stages that together do what one does in a small scene.

    Attributes:
        cpu_s: CPU seconds of all its jobs.
        largest_cpu_s: of the job that takes most.
        peak_rss_mb: largest memory of a job, MiB.
        output_mb: size of the files that it leaves, MB.
    """

    run: str
    photographs: int
    stage: str
    jobs: int
    cpu_s: float
    largest_cpu_s: float
    peak_rss_mb: float
    output_mb: float


# ---- benchmarks.wide ----


@dataclass(frozen=True)
class WideResult:
    """The demo scene, reconstructed from photographs of one lens without poses.

    Attributes:
        lens: of the photographs.
        pixels: width and height of a photograph.
        photographs, registered: numbers, of all photographs and of those with an estimated pose.
        views: number of pinhole views made of the photographs.
        rotation_median_deg, rotation_mean_deg: errors of rotations against the true poses.
        centre_relative_median: errors of camera centres, divided by their root mean square
            distance from their mean.
        psnr, ssim: of test views.
        used_share: share of the photographs' pixels that some view shows; None where photographs
            are views.
    """

    lens: str
    pixels: str
    photographs: int
    registered: int
    views: int
    rotation_median_deg: float
    rotation_mean_deg: float
    centre_relative_median: float
    psnr: float
    ssim: float
    used_share: float | None


# ---- benchmarks.slurm ----


@dataclass(frozen=True)
class SlurmResult:
    """A scene on a Slurm cluster.

    Attributes:
        nodes: number of nodes, with one core each.
        blocks: number of the scene's.
        jobs: number of submissions.
        wall_s: from the start of Snakemake to its end.
        busy_s: seconds in which at least one job runs.
        blocks_s: from the start of the first job that trains or polishes a block to the end of the
            last one; None if the scene is one block.
    """

    scene: str
    nodes: int
    blocks: int
    jobs: int
    wall_s: float
    busy_s: float
    blocks_s: float | None = None


# ---- benchmarks.budgets ----


@dataclass(frozen=True)
class BudgetResult:
    """A scene trained for a time.

    Attributes:
        trainer: "splatmake", or the name and version of another program.
        options: the configuration besides the time; of another program, its command.
        minutes: the time budget of training.
        steps: number of optimiser steps.
        psnr, ssim, lpips: of the test views; ``lpips`` is None where it was not measured.
        wall_minutes, cpu_minutes: of training, as measured.
        other_cpu_minutes: of the stages before training; None for another program, which gets
            their result.
        threads: of training.
        load_average: of the last minute at the end of training.
        test_views: their number. pixels: their sizes.
        benchmark, published_scene, deviations: see ``PublishedProtocol``; None and empty for
            scenes of no published benchmark.
    """

    scene: str
    trainer: str
    options: str
    seed: int
    minutes: float
    steps: int
    psnr: float
    ssim: float
    lpips: float | None
    gaussians: int
    wall_minutes: float
    cpu_minutes: float
    other_cpu_minutes: float | None
    threads: int
    load_average: float | None
    test_views: int
    pixels: str
    benchmark: str | None
    published_scene: str | None
    deviations: list[str]


# ---- benchmarks.pose_conventions ----

PoseOutcome = Literal["agree", "named", "refused", "warned", "silent"]
"""What became of given poses: used after a comparison that found them right; refused with the right
cause, or with another; used with a warning; used without a comparison, or although they are
wrong."""


@dataclass(frozen=True)
class PoseResult:
    """A pose file, right or with one mistake.

    Attributes:
        program: the format; empty for the scene's own file.
        mistake: empty for right poses.
        text: what was said.
        seconds: the time of plan and comparison; features and matches are computed once a scene.
    """

    scene: str
    program: str
    mistake: str
    outcome: PoseOutcome
    text: str
    seconds: float
