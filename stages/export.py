"""Files for other programs.

Outputs: ``point_cloud.ply`` (Gaussians), ``sparse/0`` (COLMAP), ``points.ply``.
"""

from pipeline.config.schema import Export
from pipeline.runtime.job import Job
from pipeline.scene.colmap import read_model, write_model
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.ply import write_points_ply, write_splat_ply
from stages.command import main


def run(job: Job) -> None:
    config = job.section(Export)
    model = read_model(job.inputs["model"] / "sparse" / "0")
    if "ply" in config.formats:
        gaussians = Gaussians.load(job.inputs["train"] / "gaussians.npz")
        if config.sh_degree < gaussians.sh_degree:
            gaussians = gaussians.with_sh_degree(config.sh_degree)
        if config.min_opacity > 0:
            gaussians = gaussians.select(gaussians.opacity_logits.sigmoid() >= config.min_opacity)
        write_splat_ply(job.out / "point_cloud.ply", gaussians)
        job.counters["exported_gaussians"] = len(gaussians)
    if "colmap" in config.formats:
        write_model(job.out / "sparse" / "0", model)
    if "points" in config.formats:
        write_points_ply(job.out / "points.ply", model.points.xyz, model.points.rgb)


if __name__ == "__main__":
    main("export", run, __doc__)
