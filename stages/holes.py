"""Fill the holes that no photograph sees with invented Gaussians, on request. Outputs:
``gaussians.npz``, the trained Gaussians followed by the invented ones; ``holes.json`` with
``masks/`` and ``painted/``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.schema import Holes, Split
from pipeline.holes.counters import HolesCounters
from pipeline.plan.hole_painter import check_hole_painter
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    fill = settled.config.holes.fill
    if fill == "none":
        return StagePlan(run=False, reason="holes.fill: none")
    check_hole_painter(fill)
    how = "inpainting" if fill == "inpaint" else "the command of holes.fill"
    return StagePlan(run=True, reason=f"invents what no photograph shows, painted by {how}")


def work(job: Job) -> None:
    from pipeline.holes.fill import fill_holes
    from pipeline.holes.outputs import write_holes
    from pipeline.holes.painters import painter_of
    from pipeline.io.npz import write_npz
    from pipeline.metrics.protocol import choose_protocol
    from pipeline.render.registry import use_device
    from pipeline.scene.views import scene_up

    fill = job.section(Holes).fill
    painter = painter_of(fill)
    views, train = inputs.trained_views(job), inputs.drawing(job)
    use_device(train.device)
    protocol = choose_protocol(views, job.section(Split), train)
    options = protocol.options(train, job.threads)
    up = scene_up(views, inputs.read_manifest(job, "views"))
    filled = fill_holes(inputs.trained_gaussians(job), views, up, painter, options)
    write_npz(job.out / "gaussians.npz", filled.gaussians)
    record = write_holes(job.out, filled, protocol.views, fill, options)
    summary = record.summary()
    job.counters = HolesCounters(
        num_invented=summary.num_gaussians,
        painted_views=summary.num_painted_views,
        invented_share=summary.mean_share,
    )
    job.decide(
        f"{summary.num_gaussians} Gaussians are invented, from {summary.num_painted_views} painted "
        f"views; {summary.mean_share:.1%} of the evaluated views' pixels are invented"
    )


SPEC = StageSpec(
    name="holes",
    work=work,
    decide=decide,
    counters=HolesCounters,
    inputs=inputs.TRAINED,
    options=("holes", "views", "split", *inputs.DRAWING_OPTIONS),
    packages=("torch", "numpy", "scipy", "opencv-contrib-python-headless"),
)
