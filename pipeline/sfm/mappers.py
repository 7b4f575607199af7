"""pycolmap's incremental and global mapper with this project's settings."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pycolmap

from pipeline.runtime.progress import Progress
from pipeline.sfm.counters import Mapper
from pipeline.sfm.models import is_uncalibrated, with_prior

# Smallest number of registered images of a model (2 for a scene of two photographs).
MIN_MODEL_SIZE = 3

# With more photographs, incremental mapping adjusts the whole model to part of its points, as many
# as constrain the poses: faster, and as accurate after the final bundle adjustment.
MAX_PHOTOS_WITH_ALL_POINTS = 200

# Smallest number of matches by which a photograph is registered in a finished model (COLMAP: 30).
MIN_INLIERS_LATER = 15

# Number of states of a model that incremental mapping saves on its way, and the smallest number of
# photographs between them. COLMAP discards a model if a late adjustment loses most of its
# photographs: the state before holds at least this share of photographs that no model has.
SNAPSHOTS, MIN_SNAPSHOT, MIN_LOST_SHARE = 10, 10, 0.2

# Global mapping uses the longest tracks only: several times faster at the same accuracy.
GLOBAL_TRACKS_PER_VIEW = 300


def run_mapper(
    mapper: Mapper, database: Path, total: int, seed: int
) -> list[pycolmap.Reconstruction]:
    """Map the database and return the models found, largest first.

    The database is not changed. Runs on one thread: with more, the result depends on the order in
    which threads finish.

    Args:
        total: The number of photographs in the database.
    """
    with tempfile.TemporaryDirectory(dir=database.parent) as folder:
        run = _map_incremental if mapper == "incremental" else _map_global
        models = run(with_fisheye_priors(database, Path(folder)), Path(folder), total, seed)
    smallest = min(MIN_MODEL_SIZE, total)
    models = [m for m in models if m.num_reg_images() >= smallest and m.num_points3D() > 0]
    # Among models with equally many images, the one with more points comes first.
    models.sort(key=lambda m: (-m.num_reg_images(), -m.num_points3D()))
    return models


def with_fisheye_priors(database: Path, folder: Path) -> Path:
    """The database, or a copy in ``folder`` in which fisheye lenses have a prior: without one
    COLMAP ignores their pairs. Mapping refines the focal length in both cases."""
    with pycolmap.Database.open(database) as opened:
        uncalibrated = [c for c in opened.read_all_cameras() if is_uncalibrated(c)]
    if not uncalibrated:
        return database
    copy = folder / "priors.db"
    shutil.copyfile(database, copy)
    with pycolmap.Database.open(copy) as opened:
        for camera in uncalibrated:
            opened.update_camera(with_prior(camera))
    return copy


def _map_incremental(
    database: Path, out: Path, total: int, seed: int
) -> list[pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1,
        random_seed=seed,
        min_model_size=min(MIN_MODEL_SIZE, total),
        extract_colors=False,
        # Fewer bundle adjustments than COLMAP's default: faster at the same accuracy.
        ba_local_max_refinements=1,
        ba_global_frames_ratio=1.5,
        ba_global_points_ratio=1.5,
        # The final bundle adjustment (refine.py) converges further; intermediate ones need not.
        ba_global_function_tolerance=1e-5,
    )
    # Two-view tracks nearly double the number of points, from which Gaussians are initialised.
    options.triangulation.ignore_two_view_tracks = False
    options.mapper.ba_global_ignore_redundant_points3D = total > MAX_PHOTOS_WITH_ALL_POINTS
    states = out / "states"
    states.mkdir()
    options.snapshot_path = states
    options.snapshot_frames_freq = max(MIN_SNAPSHOT, total // SNAPSHOTS)
    progress = Progress("mapping", total, "photographs")

    def registered() -> None:
        # An image is counted again if it is registered again or in a second model.
        if progress.done < progress.total:
            progress.advance()

    models = pycolmap.incremental_mapping(
        database, out, out, options, next_image_callback=registered
    )
    found = [models[key] for key in sorted(models)]
    return found + lost_model(states, found, total)


def lost_model(
    states: Path, models: Sequence[pycolmap.Reconstruction], total: int
) -> list[pycolmap.Reconstruction]:
    """The largest saved state of a model, if many of its photographs are in no model.

    Args:
        states: The folder with a folder for each state.
        total: The number of photographs in the database.
    """
    kept = {image_id for model in models for image_id in model.reg_image_ids()}
    if total - len(kept) < MIN_LOST_SHARE * total:
        return []
    saved = [pycolmap.Reconstruction(folder) for folder in sorted(states.iterdir())]
    largest = max(saved, key=lambda model: model.num_reg_images(), default=None)
    if largest is None:
        return []
    lost = set(largest.reg_image_ids()) - kept
    return [largest] if len(lost) >= MIN_LOST_SHARE * largest.num_reg_images() else []


def continue_mapping(
    model: pycolmap.Reconstruction, database: Path, folder: Path, seed: int
) -> pycolmap.Reconstruction:
    """Register more photographs in a model, by fewer matches than mapping asks for. Its poses and
    cameras stay as they are. Runs on one thread.

    Args:
        database: The database that the model was mapped from; not changed.
        folder: An empty folder for files.
    """
    given = folder / "given"
    given.mkdir()
    model.write_binary(given)
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1,
        random_seed=seed,
        multiple_models=False,
        extract_colors=False,
        fix_existing_frames=True,
        constant_cameras=set(model.cameras),
    )
    options.mapper.abs_pose_min_num_inliers = MIN_INLIERS_LATER
    options.triangulation.ignore_two_view_tracks = False
    found = pycolmap.incremental_mapping(
        with_fisheye_priors(database, folder), folder, folder, options, input_path=given
    )
    return max(found.values(), key=lambda m: m.num_reg_images(), default=model)


def _map_global(database: Path, out: Path, total: int, seed: int) -> list[pycolmap.Reconstruction]:
    calibrated = out / "calibrated.db"
    shutil.copyfile(database, calibrated)
    # Global mapping relies on the initial focal lengths: estimate those without a prior first.
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
