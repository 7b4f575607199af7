"""Files for other programs.

Outputs: ``point_cloud.ply`` (Gaussians), ``sparse/0`` (COLMAP), ``points.ply``; where asked for
``renders/``, ``depths/``, ``mesh.ply`` and ``.glb``, ``video`` and ``path.json``.
"""

import numpy as np

from pipeline.config.schema import Export, Split, Train, Views
from pipeline.metrics.evaluate import choose_protocol
from pipeline.runtime.job import Job
from pipeline.scene.colmap import read_model, write_model
from pipeline.scene.manifest import Manifest
from pipeline.scene.model import Reconstruction
from pipeline.scene.views import load_views, up_direction
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.ply import write_points_ply, write_splat_ply
from pipeline.surface.depth import Look
from pipeline.surface.outputs import DRAWN, write_drawn
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
        write_splat_ply(job.out / "point_cloud.ply", **gaussians.arrays())
        job.counters["exported_gaussians"] = len(gaussians)
    if "colmap" in config.formats:
        write_model(job.out / "sparse" / "0", model)
    if "points" in config.formats:
        write_points_ply(job.out / "points.ply", model.points.xyz, model.points.rgb)
    if not DRAWN.isdisjoint(config.formats):
        _draw(job, config, model)


def _draw(job: Job, config: Export, model: Reconstruction) -> None:
    """What shows the Gaussians as they were trained, from the views they were trained on."""
    manifest = Manifest.read(job.inputs["views"] / "images.json")
    split, train = job.section(Split), job.section(Train)
    views = load_views(manifest, model, job.section(Views), split)
    orientation = {photo.name: photo.orientation for photo in manifest.photos}
    rotations = np.stack([view.world_to_camera[:3, :3] for view in views])
    told = write_drawn(
        job.out,
        config.formats,
        Gaussians.load(job.inputs["train"] / "gaussians.npz"),
        views,
        Look(choose_protocol(views, split, train), train, job.threads),
        up=up_direction(rotations, [orientation[view.name] for view in views]),
        mesh_voxel=config.mesh_voxel,
    )
    for text in told.decisions:
        job.decide(text)
    for text in told.warnings:
        job.warn(text)


if __name__ == "__main__":
    main("export", run, __doc__)
