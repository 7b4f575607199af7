"""Export of a finished scene to the file formats of other programs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.config.experiments import ExportExperiments
from pipeline.config.export import (
    LOSSY_FORMATS,
    MAX_MEASURED_LOSSES,
    PLACED_FORMATS,
    RENDERED_FORMATS,
    SURVEY_FORMATS,
    Export,
)
from pipeline.config.schema import Split, Train
from pipeline.export.counters import ExportCounters, FileLoss
from pipeline.export.selection import Selection, select_gaussians
from pipeline.io.colmap import write_model
from pipeline.io.depth_tiff import write_depth_tiff
from pipeline.io.frame_json import RenderSettings, describe_frame
from pipeline.io.gltf import write_gltf
from pipeline.io.placement import to_earth
from pipeline.io.ply import write_points_ply, write_splat_ply
from pipeline.io.sog import write_sog
from pipeline.io.splat import write_splat
from pipeline.io.splat_losses import losses, unmarked
from pipeline.io.spz import write_spz
from pipeline.io.streamed_sog import write_streamed_sog
from pipeline.io.tiles3d import write_tiles3d
from pipeline.io.transforms import write_transforms
from pipeline.io.usd import write_usd
from pipeline.metrics.protocol import choose_protocol
from pipeline.mvs.maps import read_dense_cloud, read_map
from pipeline.photos.found_masks import PosedPhotos, write_photo_masks
from pipeline.photos.naming import rename
from pipeline.render import RasterOptions
from pipeline.scene.blocks import Partition
from pipeline.scene.exposure import NO_GAINS, ExposureGains
from pipeline.scene.georeference import Georeference
from pipeline.scene.manifest import Manifest
from pipeline.scene.normalization import IDENTITY, Normalization
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.unrounded import Unrounded
from pipeline.scene.views import View, scene_up
from pipeline.splats.arrays import GaussianArrays, GaussianRows
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.reduce import reduce_gaussians
from pipeline.splats.skybox import Sky

# The formats of one file with the Gaussians.
GAUSSIAN_FORMATS = ("ply", *LOSSY_FORMATS, "gltf", "usd")


@dataclass(frozen=True)
class FoundMasks:
    """What training left out of its views.

    Attributes:
        folder: The masks of the views (``photos.found_masks.write_found``).
        views, photos: The views, and the photographs before undistortion.
    """

    folder: Path
    views: PosedPhotos
    photos: PosedPhotos


@dataclass(frozen=True)
class ExportScene:
    """A finished scene.

    Attributes:
        gaussians: The Gaussians after training, followed by the invented ones.
        model: The cameras and sparse points.
        manifest: The photographs of the views.
        views: All views, at the size of the photographs.
        training_size_views: The same views at the size used in training.
        georeference: The frame of the poses; None for given poses in their own world.
        given: The given poses before rounding; empty for estimated ones.
        folder: The final folder of the exported files.
        dense: The folder of the dense stage; None if it did not run.
        partition: The blocks of the scene; None if the scene is one block.
        found: The masks that training found; None if they are not exported.
        num_invented: The number of invented Gaussians.
        gains: The exposures of the views.
    """

    gaussians: GaussianArrays
    model: Reconstruction
    manifest: Manifest
    views: list[View]
    training_size_views: list[View]
    georeference: Georeference | None
    given: Unrounded
    folder: Path
    dense: Path | None = None
    partition: Partition | None = None
    found: FoundMasks | None = None
    num_invented: int = 0
    gains: ExposureGains = NO_GAINS

    @property
    def normalization(self) -> Normalization:
        """The transformation from the world of the given poses to the scene's."""
        return IDENTITY if self.georeference is None else self.georeference.normalization


@dataclass
class ExportReport:
    """The exported files, and messages to the user."""

    counters: ExportCounters
    decisions: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Files:
    """The content that the writers write.

    Attributes:
        scene: The scene in the unit of the given poses, with its own origin, which suits float32.
        gaussians: The Gaussians of ``scene``, reduced.
        blocks: (M,) numbers of the block of each of ``gaussians``.
        model, views: The values of ``scene`` in the given world, for formats in double precision.
        antialias: Whether the Gaussians were trained with opacity compensation.
        points: The name of the file of points; None without one.
        normalization: The transformation from the given world to the scene's.
    """

    scene: ExportScene
    gaussians: GaussianRows
    blocks: NDArray[np.intp]
    model: Reconstruction
    views: list[View]
    antialias: bool
    points: str | None
    normalization: Normalization

    @property
    def moved(self) -> bool:
        """Whether the given world has another origin than the scene's."""
        return bool(self.scene.normalization.origin.any())

    def write_ply(self, path: Path) -> None:
        write_splat_ply(path, self.gaussians, antialias=self.antialias)

    def write_spz(self, path: Path, version: int) -> None:
        write_spz(path, self.gaussians, antialias=self.antialias, version=version)

    def write_sog(self, path: Path) -> None:
        write_sog(path, self.gaussians, antialias=self.antialias)

    def write_streamed_sog(self, path: Path) -> None:
        # As for training, the sky is what is much farther from the cameras than the scene.
        sky = Sky(np.array([view.centre for view in self.scene.views]))
        write_streamed_sog(
            path,
            self.gaussians,
            blocks=self.blocks,
            sky=sky.contains(self.gaussians.source.means[self.gaussians.rows]),
            antialias=self.antialias,
        )

    def write_usd(self, path: Path) -> None:
        write_usd(path, self.gaussians, scene_up(self.scene.views, self.scene.manifest))

    def write_tiles3d(self, path: Path) -> None:
        earth = None if self.scene.georeference is None else to_earth(self.scene.georeference)
        if earth is not None:
            # A skybox would hide the scene from outside.
            centres = np.stack([view.centre for view in self.scene.views])
            sky = Sky(centres).contains(self.gaussians.source.means[self.gaussians.rows])
            ground = replace(self.gaussians, rows=self.gaussians.rows[~sky])
            write_tiles3d(path, ground, earth, antialias=self.antialias)

    def write_blocks(self, path: Path) -> None:
        count = 1 if self.scene.partition is None else len(self.scene.partition.blocks)
        for number in range(1, count + 1):
            rows = self.gaussians.rows[self.blocks == number]
            part = replace(self.gaussians, rows=rows)
            write_splat_ply(path / f"block_{number}.ply", part, antialias=self.antialias)

    def write_points(self, path: Path) -> None:
        points = self.model.points
        write_points_ply(path, points.xyz, points.rgb, double=self.moved)

    def write_dense_points(self, path: Path) -> None:
        cloud = read_dense_cloud(self.dense_folder)
        xyz = self.normalization.to_given(cloud.xyz.astype(np.float64))
        write_points_ply(path, xyz, cloud.rgb, cloud.normals, double=self.moved)

    def write_dense_maps(self, path: Path) -> None:
        names = rename({view.name: ".tiff" for view in self.views})
        for view in self.views:
            if not view.is_test:
                depth = read_map(self.dense_folder, view.name).depth
                depth = depth / np.float32(self.normalization.scale)
                write_depth_tiff(path / names[view.name], depth)

    def write_masks(self, path: Path) -> None:
        found = self.scene.found
        if found is None:
            raise ValueError("expected the photographs for the configured formats")
        write_photo_masks(path, found.folder, found.views, found.photos)

    @property
    def dense_folder(self) -> Path:
        if self.scene.dense is None:
            raise ValueError("expected the output of stage dense for the configured formats")
        return self.scene.dense


# The name of the file or folder of each format, and its writer.
WRITERS: dict[str, tuple[str, Callable[[Path, _Files], None]]] = {
    "ply": ("point_cloud.ply", lambda path, f: f.write_ply(path)),
    "blocks": ("blocks", lambda path, f: f.write_blocks(path)),
    "spz": ("point_cloud.spz", lambda path, f: f.write_spz(path, 3)),
    "spz4": ("point_cloud_v4.spz", lambda path, f: f.write_spz(path, 4)),
    "sog": ("point_cloud.sog", lambda path, f: f.write_sog(path)),
    "sog_lod": ("sog_lod", lambda path, f: f.write_streamed_sog(path)),
    "splat": ("point_cloud.splat", lambda path, f: write_splat(path, f.gaussians)),
    "gltf": ("point_cloud.glb", lambda path, f: write_gltf(path, f.gaussians)),
    "usd": ("point_cloud.usdc", lambda path, f: f.write_usd(path)),
    "tiles3d": ("tiles3d", lambda path, f: f.write_tiles3d(path)),
    "points": ("points.ply", lambda path, f: f.write_points(path)),
    "colmap": ("sparse/0", lambda path, f: write_model(path, f.model)),
    "colmap_text": ("sparse_text", lambda path, f: write_model(path, f.model, text=True)),
    "transforms": (
        "transforms.json",
        lambda path, f: write_transforms(path, f.views, f.scene.folder, points=f.points),
    ),
    "dense_points": ("dense_points.ply", lambda path, f: f.write_dense_points(path)),
    "dense_maps": ("dense_maps", lambda path, f: f.write_dense_maps(path)),
    "masks": ("masks", lambda path, f: f.write_masks(path)),
}
# The formats in double precision, whose coordinates are those of the given world.
_GIVEN_WORLD = ("points", "colmap", "colmap_text", "transforms", "dense_points")


def export_scene(
    out: Path,
    scene: ExportScene,
    config: Export,
    experiments: ExportExperiments,
    train: Train,
    split: Split,
    threads: int,
) -> ExportReport:
    """Write the configured formats and ``frame.json`` into ``out``."""
    model = scene.given.model_to_given(scene.model, scene.normalization)
    poses = {name: image.world_to_camera for name, image in model.by_name().items()}
    views = [replace(view, world_to_camera=poses[view.name]) for view in scene.views]
    means = scene.gaussians.means
    normalization, scene = scene.normalization, _in_given_unit(scene)
    scene, selection = _selected(scene, config, train, split, threads)
    if len(selection.gaussians) < len(means):
        means = (selection.gaussians.means * normalization.scale).astype(np.float32)
    gaussians = reduce_gaussians(
        scene.gaussians,
        config.sh_degree,
        experiments.min_opacity,
        experiments.morton_order,
        scene.num_invented,
    )
    # The faces of blocks are in the unit of training.
    blocks = _blocks_of(means[gaussians.rows], scene.partition)
    has_points = "points" in config.formats and len(scene.model.points) > 0
    points = WRITERS["points"][0] if has_points else None
    files = _Files(scene, gaussians, blocks, model, views, train.antialias, points, normalization)
    written = []
    for name in (name for name in config.formats if name in WRITERS):
        file, write = WRITERS[name]
        write(out / file, files)
        if (out / file).exists():
            written.append(file)
    lossy = [out / WRITERS[name][0] for name in LOSSY_FORMATS if name in config.formats]
    measured = lossy if len(gaussians) <= MAX_MEASURED_LOSSES else []
    report = ExportReport(
        ExportCounters(
            exported_gaussians=len(gaussians),
            psnr_against_all=selection.psnr,
            losses=_losses(measured, files, train, split, threads) if measured else [],
        ),
        selection.decisions,
        _warnings(files, config),
    )
    if len(measured) < len(lossy):
        report.decisions.append(
            f"what compressed files lose is not measured above {MAX_MEASURED_LOSSES:,} Gaussians"
        )
    maps = SURVEY_FORMATS.intersection(config.formats)
    if scene.georeference is None or not scene.georeference.is_metric:
        maps = frozenset()
    absent = PLACED_FORMATS.intersection(config.formats) - {
        *(name for name, (file, _) in WRITERS.items() if file in written),
        *maps,
    }
    if absent:
        report.warnings.append(
            f"no {', '.join(sorted(absent))}: neither GPS positions nor ground control points "
            "place the scene on the earth"
        )
    if "masks" in config.formats and WRITERS["masks"][0] not in written:
        report.decisions.append("no masks: training left nothing out (train.transients)")
    _write_frame(out, files, written, train, split)
    if maps:
        _write_survey(out, files, config, threads, report)
    if not RENDERED_FORMATS.isdisjoint(config.formats):
        options = choose_protocol(scene.training_size_views, split, train).options(train, threads)
        _write_rendered_formats(out, scene, config, options, normalization.scale, report)
    return report


def _selected(
    scene: ExportScene, config: Export, train: Train, split: Split, threads: int
) -> tuple[ExportScene, Selection]:
    """The scene with the Gaussians that ``export.region`` and ``export.max_gaussians`` leave."""
    views, count = scene.training_size_views, len(scene.gaussians)
    if config.region is None and (config.max_gaussians or count) >= count:
        return scene, Selection(scene.gaussians, scene.num_invented)
    options = choose_protocol(views, split, train).options(train, threads)
    found = select_gaussians(
        scene.gaussians, config.max_gaussians, config.region, views, options, scene.num_invented
    )
    return replace(scene, gaussians=found.gaussians, num_invented=found.num_invented), found


def _blocks_of(means: NDArray[np.float32], partition: Partition | None) -> NDArray[np.intp]:
    return np.ones(len(means), np.intp) if partition is None else partition.numbers(means)


def _in_given_unit(scene: ExportScene) -> ExportScene:
    unit = scene.normalization.without_origin()
    if scene.georeference is None or scene.normalization.is_identity:
        return scene
    return replace(
        scene,
        gaussians=scene.gaussians.scaled(1 / unit.scale),
        model=unit.model_to_given(scene.model),
        views=[unit.view_to_given(view) for view in scene.views],
        training_size_views=[unit.view_to_given(view) for view in scene.training_size_views],
        georeference=scene.georeference.in_given_unit(),
    )


def _warnings(files: _Files, config: Export) -> list[str]:
    """The warnings about what the files of Gaussians lose."""
    names = [WRITERS[name][0] for name in GAUSSIAN_FORMATS if name in config.formats]
    warnings = [text for name in names for text in losses(Path(name), files.gaussians)]
    return [*warnings, *(unmarked(names) if files.antialias else [])]


def _write_frame(out: Path, files: _Files, written: list[str], train: Train, split: Split) -> None:
    scene = files.scene
    protocol = choose_protocol(scene.views, split, train)
    render = RenderSettings(
        background=protocol.background, near=protocol.near, antialias=files.antialias
    )
    up = scene_up(scene.views, scene.manifest)
    given = [WRITERS[name][0] for name in _GIVEN_WORLD] if files.moved else []
    first_invented = len(scene.gaussians) - scene.num_invented
    describe_frame(
        files.gaussians,
        scene.views,
        up,
        render,
        written,
        scene.georeference,
        given,
        num_invented=int((files.gaussians.rows >= first_invented).sum()),
    ).write(out)


def _losses(
    lossy: list[Path], files: _Files, train: Train, split: Split, threads: int
) -> list[FileLoss]:
    """The losses of files that were written."""
    # The module is imported here because it imports torch.
    from pipeline.export.losses import measure_losses

    protocol = choose_protocol(files.scene.training_size_views, split, train)
    options = protocol.options(train, threads)
    return measure_losses(lossy, files.gaussians, protocol.views, options)


def _write_survey(
    out: Path, files: _Files, config: Export, threads: int, report: ExportReport
) -> None:
    """Write the maps of a georeferenced scene."""
    # The module is imported here because it imports pyproj and is rarely used.
    from pipeline.survey.outputs import SurveyScene, write_survey

    scene = files.scene
    assert scene.georeference is not None
    survey = SurveyScene(
        scene.views,
        scene.training_size_views,
        scene.model,
        scene.georeference,
        scene.gains,
        files.dense_folder,
    )
    messages = write_survey(out, survey, config, threads)
    report.decisions += messages.decisions
    report.warnings += messages.warnings


def _write_rendered_formats(
    out: Path,
    scene: ExportScene,
    config: Export,
    options: RasterOptions,
    scale: float,
    report: ExportReport,
) -> None:
    """Write the formats that need renders of the trained Gaussians.

    Args:
        scale: The length of the unit of ``scene`` in the unit of training.
    """
    # The module is imported here because it imports torch and is rarely used.
    from pipeline.surface.outputs import Observed, write_rendered

    # Depths of multi-view stereo are not cropped.
    dense = scene.dense if "mesh" in config.dense_formats else None
    messages = write_rendered(
        out,
        config,
        Gaussians.sharing(scene.gaussians),
        scene.training_size_views,
        options,
        up=scene_up(scene.views, scene.manifest),
        origin=scene.normalization.origin,
        num_invented=scene.num_invented,
        observed=Observed(scene.gains, dense, 1 / scale, scene.model.points.xyz),
    )
    report.decisions += messages.decisions
    report.warnings += messages.warnings
