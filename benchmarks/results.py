"""Results of the benchmarks, as printed and stored in records.

The results of the SfM benchmark are in ``benchmarks.sfm.summary``.
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


# ---- benchmarks.files ----


@dataclass(frozen=True)
class FileResult:
    """A file of the Gaussians of a scene.

    Attributes:
        writer: The program that wrote it.
        size_mb: Millions of bytes.
        psnr: Of its renders against those of the PLY file, dB; 100 for equal pictures.
        cpu_s: The processor time of writing it; None for files of other programs.
    """

    scene: str
    gaussians: int
    sh_degree: int
    format: str
    writer: str
    size_mb: float
    psnr: float
    cpu_s: float | None


# ---- benchmarks.novel_views ----


@dataclass(frozen=True)
class NovelViewResult:
    """The novel views of one kind of a finished scene.

    Attributes:
        run: The name of its folder.
        against: The name of the folder of the model that it is compared with; empty without one.
        kind: One of ``pipeline.coverage.novel_views.KINDS``.
        views: The number of views.
        contradicted_share, unseen_share: The mean shares of pixels, as in ``coverage.json``.
        psnr, ssim: The means between the renders of the two models; None without another model.
    """

    run: str
    against: str
    kind: str
    views: int
    contradicted_share: float
    unseen_share: float
    psnr: float | None
    ssim: float | None


# ---- benchmarks.memory ----


@dataclass(frozen=True)
class MemoryResult:
    """The memory of a training.

    Attributes:
        gaussians, most_gaussians: The number at the end, and the largest during training.
        width, height: The size of each view, pixels.
        checkpoints_mb: The size of the checkpoints, MB.
        planned_mb, peak_mb: The plan's estimate and the measured peak, MB.
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
    """The cost and the errors of mapping a number of photographs.

    Attributes:
        cpu_s, peak_mb: The CPU seconds and the peak memory (MiB) of mapping alone.
        power: The exponent of the time's growth since the last number of views; None for the first.
        registered: The number of images with a pose.
        rotation_deg, centre_m: The median errors.
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
    """The result of a case; ``truth`` is None without ground truth."""

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
    """The outcome of a case.

    Attributes:
        what: The case in words.
        code: Snakemake's exit code.
        psnr, ssim: The means over the test views; None if the run failed.
        reference: The case whose quality it should have, if any.
        difference_db: The PSNR minus that of the reference; None if either is unknown.
        gaussians: The final number of Gaussians.
        message: The message of the error, or the warnings of the result.
        traceback: Whether a traceback was printed.
        right: Whether the outcome is the expected one.
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


# ---- benchmarks.raster_stress ----


@dataclass(frozen=True)
class StressResult:
    """A family of inputs.

    Attributes:
        cases, drawn, dropped: The numbers of Gaussians.
        not_finite: The number of values of images and gradients that are not finite.
        colour: See ``benchmarks.raster_stress.Tally``.
        gradient_median, gradient_p99, gradient_worst: The relative errors over calls.
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
        phase_ms: The time of the kernels of each phase of a step, by the device's timestamps.
        step_ms, cpu_step_ms: The wall time of a step.
        frames_per_s, cpu_frames_per_s: The rate of rendering alone, with the copy of the image.
        bandwidth: The bytes per second that copies inside the device's memory read and write.
        moments_bandwidth: The bytes of SH coefficients and moments over the time of the kernel
            that updates them.
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


# ---- benchmarks.gpu_counts ----


@dataclass(frozen=True)
class GpuCountsResult:
    """The work of a training step on a GPU.

    Attributes:
        pairs: The number of (Gaussian, tile) pairs.
        steps: The number of steps of a small scene whose waits were counted.
        waits: The number of times that the processor waited for the device in all of them.
        dispatches, copies, submissions: Of kernels, of copies and clears of buffers, and of command
            buffers, in a step.
        uploaded_mb: Copied to the device in a step.
        memory_mb: The bytes in use of each buffer, read and written once by each kernel that
            reads it or writes to it, in a step.
        gflop: The arithmetic of a step if no pixel is done before the last Gaussian.
    """

    gaussians: int
    width: int
    height: int
    pairs: int
    steps: int
    waits: int
    dispatches: float
    copies: float
    submissions: float
    uploaded_mb: float
    memory_mb: dict[str, float]
    gflop: float


# ---- benchmarks.blocks ----


@dataclass(frozen=True)
class BlocksResult:
    """A scene as one block, and in blocks; pairs are in this order.

    Attributes:
        run: The name of the run as one block.
        seed: The seed of both.
        pixels: The width and height of a view.
        psnr, ssim: The means over the test views.
        gaussians: The numbers of trained Gaussians.
        training_rss_mb: The largest memory of a job of training, MiB.
        peak_rss_mb: The largest memory of any job, MiB.
        training_cpu_s: The CPU seconds of all training jobs.
        largest_block_cpu_s: The CPU seconds of the block that takes longest.
        seam_gradient: The mean gradient of the error images of the test views across the seams of
            the blocks, divided by that elsewhere. The first run has no seams, so its value comes
            from what the photographs show there.
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
        cpu_s: The CPU seconds of all its jobs.
        largest_cpu_s: The CPU seconds of the job that takes most.
        peak_rss_mb: The largest memory of a job, MiB.
        output_mb: The size of the files that it leaves, MB.
    """

    run: str
    photographs: int
    stage: str
    jobs: int
    cpu_s: float
    largest_cpu_s: float
    peak_rss_mb: float
    output_mb: float


# ---- benchmarks.slurm ----


@dataclass(frozen=True)
class SlurmResult:
    """A scene on a Slurm cluster.

    Attributes:
        nodes: The number of nodes, with one core each.
        blocks: The number of the scene's blocks.
        jobs: The number of submissions.
        wall_s: The seconds from the start of Snakemake to its end.
        busy_s: The seconds in which at least one job runs.
        blocks_s: The time from the start of the first job that trains or polishes a block to the
            end of the last one; None if the scene is one block.
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
        options: The configuration besides the time.
        minutes: The time budget of training.
        steps: The number of optimiser steps.
        psnr, ssim, flip, lpips: The means over the test views; None if not measured.
        wall_minutes, cpu_minutes: The measured time of training.
        other_cpu_minutes: The CPU time of the stages before training.
        threads: The number of threads of training.
        load_average: The load average of the last minute at the end of training.
        test_views: The number of test views.
        pixels: The sizes of the test views.
    """

    scene: str
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
    other_cpu_minutes: float
    threads: int
    load_average: float | None
    test_views: int
    pixels: str
    flip: float | None = None


# ---- benchmarks.light ----


@dataclass(frozen=True)
class LightResult:
    """A world of ``benchmarks.light``, trained and measured on test views in reference conditions.

    Attributes:
        views: The number of photographs.
        pixels: The size of the photographs.
        option: The option ``train.appearance``.
        chosen: The model of appearance that was used: "none", "exposure" or "embedding".
        gaussians: The number of Gaussians.
        psnr: The mean over the test views by the stated protocol: with gains, or with the
            appearance fitted on the left half and measured on the right half.
        psnr_right: The same on the right halves, for any model of appearance.
        psnr_own: The mean without gains or fit.
        psnr_withheld: The mean over the withheld views, without gains or fit; None without any.
        seconds: The time of training.
    """

    world: str
    seed: int
    views: int
    pixels: str
    steps: int
    option: str
    chosen: str
    gaussians: int
    psnr: float
    psnr_right: float
    psnr_own: float
    psnr_withheld: float | None
    seconds: float


# ---- benchmarks.surface ----


@dataclass(frozen=True)
class SurfaceResult:
    """A mesh of a synthetic scene.

    Attributes:
        depths: The depth maps: "rendered" alone, or "both" with those of multi-view stereo.
        share: The wanted number of triangles, over that of marching cubes.
        voxel_mm: The side of a voxel.
        vertex_error_mm: The median distance of the vertices from the true surface.
        error_mm, p90_mm: The median and the 90th percentile of the distance of points spread evenly
            over the mesh.
        completeness: The share of the true surface, where at least three training views see it,
            within two voxels of the mesh.
        psnr_vertices, psnr_texture: Of renders in the test views, with colours at the vertices and
            with the texture; None without one.
        texture_px: The larger of the texture's width and height; 0 without one.
        mesh_s, texture_s, train_s, dense_s: The times of the mesh and its texture, of training and
            of multi-view stereo.
        thin_completeness: ``completeness`` of the parts that are thin (``true_surface.THIN``); None
            where they are not told apart.
    """

    seed: int
    pixels: str
    depths: str
    share: float
    triangles: int
    voxel_mm: float
    vertex_error_mm: float
    error_mm: float
    p90_mm: float
    completeness: float
    psnr_vertices: float
    psnr_texture: float | None
    texture_px: int
    mesh_s: float
    texture_s: float | None
    train_s: float
    dense_s: float
    scene: str = "demo"
    thin_completeness: float | None = None


# ---- benchmarks.levels ----


@dataclass(frozen=True)
class LevelResult:
    """A level of detail against all Gaussians, by ``benchmarks.levels``.

    Attributes:
        level: 0 is the finest, which is all Gaussians.
        gaussians: The number of Gaussians of the level.
        views: The number of test views.
        depth: The median depth of the Gaussians in the test views, in scene units.
        spacing: The mean distance of the level's Gaussians to their nearest neighbour, in scene
            units.
        distance: The distance at which ``spacing`` is one pixel of the test views.
        pixels: The size at which test views show the scene as from ``distance``.
        psnr: The mean PSNR of renders against those of all Gaussians at that size, in dB; None for
            level 0.
        psnr_averaged: The same against renders of all Gaussians at the size of the test views, each
            pixel the mean over its area.
        near_pixels: The size of the test views.
        psnr_near: As ``psnr``, at the size of the test views.
    """

    level: int
    gaussians: int
    views: int
    depth: float
    spacing: float
    distance: float
    pixels: str
    psnr: float | None
    psnr_averaged: float
    near_pixels: str
    psnr_near: float | None


# ---- benchmarks.page ----


@dataclass(frozen=True)
class PrunedResult:
    """A file of a scene's Gaussians, by ``benchmarks.pruned``. The first of a record has all.

    Attributes:
        scene: The name of the scene.
        training: How the scene was trained.
        gaussians: The number of Gaussians of the file.
        views: The number of test views.
        pixels: Their size.
        psnr, ssim: The means over the test views, against the photographs; PSNR in dB.
    """

    scene: str
    training: str
    gaussians: int
    views: int
    pixels: str
    psnr: float
    ssim: float


@dataclass(frozen=True)
class StreamedResult:
    """How a browser loads a Streamed SOG with another program's engine, by ``benchmarks.streamed``.
    Times are medians over runs, in seconds since the navigation began.

    Attributes:
        scene: The name of the scene.
        gaussians: The number of Gaussians of the finest level, without the sky.
        files: The number of SOG files.
        file_mb: The size of all files in MB.
        engine: The program that loads them, with its version.
        budget: The engine's limit of the Gaussians that it draws.
        runs: The number of runs.
        first_s: The first picture with Gaussians is drawn.
        slowest_first_s: The largest ``first_s``.
        complete_s: The picture with all levels that the engine chooses is drawn.
        most_drawn: The largest number of Gaussians that were drawn at once, in all runs.
        most_resident: The largest number of Gaussians in memory, in all runs.
    """

    scene: str
    gaussians: int
    files: int
    file_mb: float
    engine: str
    budget: int
    runs: int
    first_s: float
    slowest_first_s: float
    complete_s: float
    most_drawn: int
    most_resident: int


@dataclass(frozen=True)
class PageResult:
    """How soon the page of a scene shows it, by ``benchmarks.page``. Seconds are medians over runs,
    since the navigation began, of pictures that the browser has drawn.

    Attributes:
        page: The name of the page's folder.
        gaussians: The number of Gaussians of the file beside the page; None if there is none.
        page_mb: The size of the page in MB.
        runs: The number of runs.
        arrived_s: The page's last byte has arrived. A page that starts to draw before can delay it.
        first_s: The first picture with Gaussians is drawn.
        first_after_arrival_s: The same since ``arrived_s`` of the same run.
        slowest_first_s: The largest ``first_s``.
        own_s: A picture with the page's own Gaussians is drawn.
        frames_per_s: The frames that are drawn per second while the mouse turns the scene.
    """

    page: str
    gaussians: int | None
    page_mb: float
    runs: int
    arrived_s: float
    first_s: float
    first_after_arrival_s: float
    slowest_first_s: float
    own_s: float
    frames_per_s: float


# ---- benchmarks.pose_conventions ----

PoseOutcome = Literal["agree", "named", "refused", "warned", "silent"]
"""What became of given poses: used after a comparison that found them right; refused with the right
cause, or with another; used with a warning; used without a comparison, or although they are
wrong."""


@dataclass(frozen=True)
class PoseResult:
    """A pose file, right or with one mistake.

    Attributes:
        program: The format; empty for the scene's own file.
        mistake: The name of the mistake; empty for right poses.
        text: What was said.
        seconds: The time of plan and comparison; features and matches are computed once a scene.
    """

    scene: str
    program: str
    mistake: str
    outcome: PoseOutcome
    text: str
    seconds: float


# ---- benchmarks.serial ----

STEP = "step"


@dataclass(frozen=True)
class SerialResult:
    """A phase of a training step on one thread and on several.

    Attributes:
        phase: ``STEP`` for the sum of all phases.
        one_ms, many_ms: The time of the phase in a step, on one thread and on ``threads``.
        busy_ms: The time of all ``threads`` together in ``many_ms`` while they do not wait.
        step_ms: The time of the step on one thread.
    """

    scene: str
    threads: int
    phase: str
    one_ms: float
    many_ms: float
    busy_ms: float
    step_ms: float

    def serial_ms(self, work: float) -> float:
        """The serial part by Amdahl's law, T(n) = serial + (work - serial) / n."""
        return (self.threads * self.many_ms - work) / (self.threads - 1)

    @property
    def share(self) -> float:
        """The serial part over the step on one thread, if the work is that of one thread."""
        return self.serial_ms(self.one_ms) / self.step_ms

    @property
    def waiting_share(self) -> float:
        """The same if the work is that of all threads while they do not wait: what they lose to
        each other's memory traffic is no serial part."""
        return self.serial_ms(self.busy_ms) / self.step_ms
