"""pycolmap's two mappers, set up."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Literal

import pycolmap

from pipeline.runtime.progress import Progress

Mapper = Literal["incremental", "global"]

# A smaller model is no reconstruction; of two photographs, two must do.
MIN_MODEL_SIZE = 3

# Global mapping on the longest tracks alone: three times as fast, as accurate.
GLOBAL_TRACKS_PER_VIEW = 300


def run_mapper(
    mapper: Mapper, database: Path, total: int, seed: int
) -> list[pycolmap.Reconstruction]:
    """The models found, largest first; the database is not changed.

    On one thread: the libraries sum in the order their threads finish.

    Args:
        total: photographs in the database.
    """
    with tempfile.TemporaryDirectory(dir=database.parent) as folder:
        run = _map_incremental if mapper == "incremental" else _map_global
        models = run(database, Path(folder), total, seed)
    smallest = min(MIN_MODEL_SIZE, total)
    models = [m for m in models if m.num_reg_images() >= smallest and m.num_points3D() > 0]
    # Ties go to the model with more points, then to the first found.
    models.sort(key=lambda m: (-m.num_reg_images(), -m.num_points3D()))
    return models


def _map_incremental(
    database: Path, out: Path, total: int, seed: int
) -> list[pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1,
        random_seed=seed,
        min_model_size=min(MIN_MODEL_SIZE, total),
        extract_colors=False,
        # Fewer global adjustments: a third faster, as accurate.
        ba_local_max_refinements=1,
        ba_global_frames_ratio=1.5,
        ba_global_points_ratio=1.5,
        # The last adjustment, which frees the cameras (refine.py), goes on to the end; those on the
        # way need not: a fifth of the time, as accurate.
        ba_global_function_tolerance=1e-5,
    )
    # 1.8 times the points at the same accuracy, and points are what Gaussians start from.
    options.triangulation.ignore_two_view_tracks = False
    progress = Progress("mapping", total, "photographs")

    def registered() -> None:
        # Photographs tried again, or in a second model, count once more: stop at the total.
        if progress.done < progress.total:
            progress.advance()

    models = pycolmap.incremental_mapping(
        database, out, out, options, next_image_callback=registered
    )
    return [models[key] for key in sorted(models)]


def _map_global(database: Path, out: Path, total: int, seed: int) -> list[pycolmap.Reconstruction]:
    calibrated = out / "calibrated.db"
    shutil.copyfile(database, calibrated)
    # Global mapping trusts the focal lengths it is given: estimate those without a prior first.
    pycolmap.calibrate_view_graph(
        calibrated, pycolmap.ViewGraphCalibrationOptions(random_seed=seed)
    )
    options = pycolmap.GlobalPipelineOptions(
        num_threads=1, random_seed=seed, min_model_size=min(MIN_MODEL_SIZE, total)
    )
    options.mapper.num_threads = 1
    options.mapper.random_seed = seed
    options.mapper.track_required_tracks_per_view = GLOBAL_TRACKS_PER_VIEW
    options.mapper.retriangulation.ignore_two_view_tracks = False
    models = pycolmap.global_mapping(calibrated, out, out, options)
    return [models[key] for key in sorted(models)]
