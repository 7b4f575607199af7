"""Files for other programs.

Outputs: Gaussians (``point_cloud.ply``, ``blocks/``, ``.spz``, ``.sog``, ``sog_lod/``, ``.splat``,
``.glb``, ``.usdc``); sparse points (``points.ply``); cameras (``sparse/0`` and ``sparse_text``,
COLMAP; ``transforms.json``); ``frame.json`` with axes, unit and up direction. On demand
``dense_points.ply``, ``dense_maps/``, ``masks/``, ``renders/``, ``depths/``, ``mesh.ply`` and
``.glb``, ``video`` and ``path.json``; ``tiles3d/``, ``orthophoto.tif``, ``dsm.tif``,
``dense_points.laz`` and ``accuracy.html`` of scenes that have a place on the earth.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

from pipeline.config.experiments import Experiments
from pipeline.config.export import BLOCKS_FORMAT, MASKS_FORMAT, Export
from pipeline.config.schema import Split, Views
from pipeline.config.section import MAX_SIDE_PX
from pipeline.export.counters import ExportCounters
from pipeline.io.usd import check_usd
from pipeline.plan.mesh_voxel import check_mesh_voxel
from pipeline.plan.placed import check_placed
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import Plan, StagePlan
from pipeline.plan.video_path import check_video_path
from pipeline.runtime.errors import UserError
from pipeline.runtime.job import Job
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.export.write import FoundMasks
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled

# Exported cameras are those of the full-size images, whatever the size of training views.
FULL_SIZE = Views(max_long_side_px=MAX_SIDE_PX)


def decide(scan: Scan, settled: Settled) -> StagePlan:
    config = settled.config
    reason = ", ".join(config.export.formats) or "no format"
    check_video_path(scan, config.export)
    check_placed(scan, config)
    if "usd" in config.export.formats:
        check_usd()
    return StagePlan(run=True, reason=reason, decisions=check_mesh_voxel(scan, config))


def work(job: Job) -> None:
    from pipeline.export.write import ExportScene, export_scene
    from pipeline.holes.record import num_invented
    from pipeline.io.appearance_files import Embeddings
    from pipeline.render.registry import use_device
    from pipeline.scene.blocks import Partition
    from pipeline.scene.exposure import ExposureGains
    from pipeline.scene.unrounded import Unrounded
    from pipeline.scene.views import load_views

    _check_unchanged(job)
    train = inputs.drawing(job)
    use_device(train.device)
    manifest, model, split = (
        inputs.read_manifest(job, "views"),
        inputs.trained_model(job),
        job.section(Split),
    )
    scene = ExportScene(
        gaussians=inputs.filled_arrays(job),
        num_invented=num_invented(job.inputs.get("holes")),
        gains=ExposureGains.read(job.inputs["train"]),
        model=model,
        manifest=manifest,
        views=load_views(manifest, model, FULL_SIZE, split),
        training_size_views=inputs.trained_views(job),
        georeference=inputs.georeference(job),
        given=Unrounded.read(job.inputs["inspect"]),
        folder=job.inputs["train"].parent / job.stage,
        dense=job.inputs.get("dense"),
        partition=Partition.read(folder) if (folder := job.inputs.get("partition")) else None,
        found=_found_masks(job),
    )
    report = export_scene(
        job.out,
        scene,
        job.section(Export),
        job.section(Experiments).export,
        train,
        split,
        threads=job.threads,
    )
    if (job.inputs["train"] / Embeddings.file_name).is_file():
        job.decide(
            "photographs differ in their light: the exported colours are those of the mean of "
            "their appearance embeddings and of their typical exposure"
        )
    job.record(report.counters, report.decisions, report.warnings)


def _found_masks(job: Job) -> FoundMasks | None:
    from pipeline.export.write import FoundMasks
    from pipeline.photos.found_masks import PosedPhotos

    if "photos" not in job.inputs:
        return None
    return FoundMasks(
        job.inputs["train"] / inputs.TRANSIENTS,
        PosedPhotos(inputs.read_manifest(job, "views"), inputs.input_model(job, points=False)),
        PosedPhotos(
            inputs.read_manifest(job, "photos"), inputs.input_model(job, "poses", points=False)
        ),
    )


def facts(plan: Plan) -> dict[str, Any]:
    if "video" not in plan.config.export.formats:
        return {}
    from pipeline.surface.video import find_h264

    return {"h264": find_h264() is not None, "video_path": _digest(plan.config.export)}


def _digest(export: Export) -> str | None:
    """The digest of the file with the video's cameras; None without one."""
    named = export.video.path_file
    return None if named is None else hashlib.sha256(named.read_bytes()).hexdigest()


def _check_unchanged(job: Job) -> None:
    """Raises: UserError: the file with the video's cameras changed after the run had started."""
    export = job.section(Export)
    if "video" in export.formats and _digest(export) != job.key.get("video_path"):
        file = export.video.path_file
        raise UserError("changed while the run went on", file=file, fix="start the run again")


SPEC = StageSpec(
    name="export",
    work=work,
    decide=decide,
    counters=ExportCounters,
    inputs=inputs.TRAINED
    | inputs.HOLES
    | {"inspect": ("inspect",), "dense": ("dense",), "partition": ("partition",)}
    | {"photos": inputs.PHOTOS},
    only_if={
        "dense": lambda config: bool(config.export.dense_formats),
        "partition": lambda config: BLOCKS_FORMAT in config.export.formats,
        "photos": lambda config: MASKS_FORMAT in config.export.formats,
    },
    optional=("partition", "holes"),
    options=("export", "experiments.export", "views", "split", *inputs.DRAWING_OPTIONS),
    facts=facts,
    packages=(
        "torch",
        "numpy",
        "zstandard",
        "scipy",
        "scikit-image",
        "fast-simplification",
        "xatlas",
        "opencv-contrib-python-headless",
        "pyproj",
        "laspy",
        "lazrs",
    ),
)
