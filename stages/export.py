"""Files for other programs.

Outputs: of the Gaussians ``point_cloud.ply``, ``.spz``, ``.splat``, ``.glb``; the sparse points,
``points.ply``; the cameras, ``sparse/0`` and ``sparse_text`` (COLMAP) and ``transforms.json``; and
``frame.json``, which says what they leave open. Where asked for ``renders/``, ``depths/``,
``mesh.ply`` and ``.glb``, ``video`` and ``path.json``.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.config.schema import Export, Split, Train, Views
from pipeline.metrics.evaluate import choose_protocol
from pipeline.runtime.atomic import write_json
from pipeline.runtime.job import Job
from pipeline.scene.colmap import write_model
from pipeline.scene.manifest import Manifest
from pipeline.scene.model import Reconstruction, View
from pipeline.scene.transforms import write_transforms
from pipeline.scene.views import load_views, scene_up
from pipeline.splats.files import prepare
from pipeline.splats.frame import describe_frame
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.gltf import write_gltf
from pipeline.splats.ply import write_points_ply, write_splat_ply
from pipeline.splats.splat import write_splat
from pipeline.splats.spz import unfit, write_spz
from stages.command import main
from stages.models import trained_model


@dataclass(frozen=True)
class Scene:
    """What is exported.

    Attributes:
        views: at the pictures' own size.
        antialias: how the Gaussians were trained.
        folder: where the files will be in the end.
        points: name of the exported point cloud, None without one or with an empty one.
    """

    gaussians: Gaussians
    model: Reconstruction
    views: list[View]
    antialias: bool
    folder: Path
    points: str | None


# Cameras belong to the pictures as they are, whatever size training took them in.
FULL_SIZE = Views(max_long_side_px=2**31)

# Of Gaussians that a format cannot hold: some specks are always lost.
TOLERATED_SHARE = 0.05

# Formats that cannot say that opacities are to be compensated.
SILENT = ("ply", "splat", "gltf")

# format -> the file or folder, and what writes it.
WRITERS: dict[str, tuple[str, Callable[[Path, Scene], None]]] = {
    "ply": ("point_cloud.ply", lambda path, s: write_splat_ply(path, s.gaussians)),
    "spz": ("point_cloud.spz", lambda path, s: write_spz(path, s.gaussians, antialias=s.antialias)),
    "splat": ("point_cloud.splat", lambda path, s: write_splat(path, s.gaussians)),
    "gltf": ("point_cloud.glb", lambda path, s: write_gltf(path, s.gaussians)),
    "points": (
        "points.ply",
        lambda path, s: write_points_ply(path, s.model.points.xyz, s.model.points.rgb),
    ),
    "colmap": ("sparse/0", lambda path, s: write_model(path, s.model)),
    "colmap_text": ("sparse_text", lambda path, s: write_model(path, s.model, text=True)),
    "transforms": (
        "transforms.json",
        lambda path, s: write_transforms(path, s.views, s.folder, points=s.points),
    ),
}


def run(job: Job) -> None:
    config, train, split = job.section(Export), job.section(Train), job.section(Split)
    manifest = Manifest.read(job.inputs["views"] / "images.json")
    model = trained_model(job)
    trained = Gaussians.load(job.inputs["train"] / "gaussians.npz")
    scene = Scene(
        gaussians=prepare(trained, config.sh_degree, config.min_opacity, config.morton_order),
        model=model,
        views=load_views(manifest, model, FULL_SIZE, split),
        antialias=train.antialias,
        folder=job.inputs["train"].parent / job.stage,
        points=WRITERS["points"][0] if "points" in config.formats and len(model.points) else None,
    )
    files = []
    for name in (name for name in config.formats if name in WRITERS):
        file, write = WRITERS[name]
        write(job.out / file, scene)
        files.append(file)
    lost = unfit(scene.gaussians) if "spz" in config.formats else 0
    if lost > TOLERATED_SHARE * len(scene.gaussians):
        job.warn(
            f"point_cloud.spz: {lost} of {len(scene.gaussians)} Gaussians are too small or too "
            "large for SPZ's numbers in the unit of the poses; take point_cloud.ply, or give the "
            "poses in a unit in which the scene measures about 1 to 100"
        )
    silent = [WRITERS[name][0] for name in SILENT if name in config.formats]
    if train.antialias and silent:
        job.warn(
            f"{' and '.join(silent)} cannot say that the Gaussians were trained with "
            "train.antialias, and a viewer without Mip-Splatting's compensation draws them far too "
            "thick: switch it on there, take point_cloud.spz, which says so, or train without"
        )
    protocol = choose_protocol(scene.views, split, train)
    up = scene_up(scene.views, manifest)
    render = {
        "background": list(protocol.background),
        "near": protocol.near,
        "antialias": train.antialias,
    }
    placed = job.inputs["poses"] / "georeference.json"
    georeference = json.loads(placed.read_text()) if placed.is_file() else None
    frame = describe_frame(scene.gaussians, scene.views, up, render, files, georeference)
    write_json(job.out / "frame.json", frame)
    job.counters["exported_gaussians"] = len(scene.gaussians)
    if not set(config.formats) <= WRITERS.keys():
        draw(job, trained, load_views(manifest, model, job.section(Views), split), up)


def draw(job: Job, trained: Gaussians, views: list[View], up: NDArray[np.float64]) -> None:
    """What shows the Gaussians as they were trained, from the views they were trained on."""
    # Not for everybody, and heavy: marching cubes, video encoders.
    from pipeline.surface.outputs import write_drawn

    config, train, split = job.section(Export), job.section(Train), job.section(Split)
    told = write_drawn(
        job.out,
        config.formats,
        trained,
        views,
        choose_protocol(views, split, train).options(train, job.threads),
        up=up,
        mesh_voxel=config.mesh_voxel,
    )
    for text in told.decisions:
        job.decide(text)
    for text in told.warnings:
        job.warn(text)


if __name__ == "__main__":
    main("export", run, __doc__)
