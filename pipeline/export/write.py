"""A finished scene as files for other programs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.config.schema import Export, Split, Train
from pipeline.io.colmap import write_model
from pipeline.io.frame_json import describe_frame
from pipeline.io.gltf import write_gltf
from pipeline.io.ply import write_points_ply, write_splat_ply
from pipeline.io.splat import write_splat
from pipeline.io.spz import count_out_of_range, write_spz
from pipeline.io.transforms import write_transforms
from pipeline.metrics.evaluate import choose_protocol
from pipeline.runtime.atomic import write_json
from pipeline.scene.manifest import Manifest
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View, scene_up
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.reduce import prepare

# Share of the Gaussians that may not fit into a format without a warning: some specks always fail.
TOLERATED_SHARE = 0.05
# Formats that cannot record that the Gaussians were trained with opacity compensation.
WITHOUT_ANTIALIAS = ("ply", "splat", "gltf")


@dataclass(frozen=True)
class ExportScene:
    """What is exported.

    Attributes:
        trained: the Gaussians as training left them.
        model: cameras and sparse points.
        manifest: the photographs of the views.
        views: at the photographs' own size.
        drawn: the same views at the size of training.
        georeference: the model's frame (``georeference.json``), None without one.
        folder: where the files will be in the end.
    """

    trained: Gaussians
    model: Reconstruction
    manifest: Manifest
    views: list[View]
    drawn: list[View]
    georeference: dict[str, Any] | None
    folder: Path


@dataclass
class ExportReport:
    """What was exported, and what is said of it."""

    exported_gaussians: int
    decisions: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Files:
    scene: ExportScene
    gaussians: Gaussians
    antialias: bool
    points: str | None


# format -> the file or folder, and its writer.
WRITERS: dict[str, tuple[str, Callable[[Path, _Files], None]]] = {
    "ply": ("point_cloud.ply", lambda path, f: write_splat_ply(path, f.gaussians)),
    "spz": ("point_cloud.spz", lambda path, f: write_spz(path, f.gaussians, antialias=f.antialias)),
    "splat": ("point_cloud.splat", lambda path, f: write_splat(path, f.gaussians)),
    "gltf": ("point_cloud.glb", lambda path, f: write_gltf(path, f.gaussians)),
    "points": (
        "points.ply",
        lambda path, f: write_points_ply(path, f.scene.model.points.xyz, f.scene.model.points.rgb),
    ),
    "colmap": ("sparse/0", lambda path, f: write_model(path, f.scene.model)),
    "colmap_text": ("sparse_text", lambda path, f: write_model(path, f.scene.model, text=True)),
    "transforms": (
        "transforms.json",
        lambda path, f: write_transforms(path, f.scene.views, f.scene.folder, points=f.points),
    ),
}


def export_scene(
    out: Path, scene: ExportScene, config: Export, train: Train, split: Split, threads: int
) -> ExportReport:
    """Write the configured formats and ``frame.json`` into ``out``."""
    gaussians = prepare(scene.trained, config.sh_degree, config.min_opacity, config.morton_order)
    has_points = "points" in config.formats and len(scene.model.points) > 0
    files = _Files(scene, gaussians, train.antialias, WRITERS["points"][0] if has_points else None)
    written = []
    for name in (name for name in config.formats if name in WRITERS):
        file, write = WRITERS[name]
        write(out / file, files)
        written.append(file)
    report = ExportReport(len(gaussians), warnings=_warnings(files, config))
    _write_frame(out, files, written, train, split)
    if not set(config.formats) <= WRITERS.keys():
        _draw(out, scene, config, train, split, threads, report)
    return report


def _warnings(files: _Files, config: Export) -> list[str]:
    warnings = []
    lost = count_out_of_range(files.gaussians) if "spz" in config.formats else 0
    if lost > TOLERATED_SHARE * len(files.gaussians):
        warnings.append(
            f"point_cloud.spz: {lost} of {len(files.gaussians)} Gaussians are too small or too "
            "large for SPZ's numbers in the unit of the poses; take point_cloud.ply, or give the "
            "poses in a unit in which the scene measures about 1 to 100"
        )
    silent = [WRITERS[name][0] for name in WITHOUT_ANTIALIAS if name in config.formats]
    if files.antialias and silent:
        warnings.append(
            f"{' and '.join(silent)} cannot say that the Gaussians were trained with "
            "train.antialias, and a viewer without Mip-Splatting's compensation draws them far too "
            "thick: switch it on there, take point_cloud.spz, which says so, or train without"
        )
    return warnings


def _write_frame(out: Path, files: _Files, written: list[str], train: Train, split: Split) -> None:
    scene = files.scene
    protocol = choose_protocol(scene.views, split, train)
    render = {
        "background": list(protocol.background),
        "near": protocol.near,
        "antialias": files.antialias,
    }
    up = scene_up(scene.views, scene.manifest)
    frame = describe_frame(files.gaussians, scene.views, up, render, written, scene.georeference)
    write_json(out / "frame.json", frame)


def _draw(
    out: Path,
    scene: ExportScene,
    config: Export,
    train: Train,
    split: Split,
    threads: int,
    report: ExportReport,
) -> None:
    """The formats that draw the Gaussians, as they were trained, from the views of training."""
    # Rarely asked for, and heavy: marching cubes, video encoders.
    from pipeline.surface.outputs import write_drawn

    told = write_drawn(
        out,
        config.formats,
        scene.trained,
        scene.drawn,
        choose_protocol(scene.drawn, split, train).options(train, threads),
        up=scene_up(scene.views, scene.manifest),
        mesh_voxel=config.mesh_voxel,
    )
    report.decisions += told.decisions
    report.warnings += told.warnings
