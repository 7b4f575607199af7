"""Runs of a configuration, each step in a separate process."""

from __future__ import annotations

import resource
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.sfm.scenes import Configuration, Scene
from benchmarks.sfm.summary import REFERENCE, STEPS, Cost, Run
from pipeline.config.settled import Config
from pipeline.io.colmap import read_model
from pipeline.metrics.pose import pose_error
from pipeline.runtime.errors import UserError
from pipeline.runtime.isolate import run_isolated
from pipeline.runtime.memory import peak_memory_mb
from pipeline.scene.manifest import Manifest


def run_once(scene: Scene, configuration: Configuration | None, threads: int) -> Run:
    """Run a configuration from photographs to poses; None is pycolmap's defaults."""
    with tempfile.TemporaryDirectory(prefix="benchmark-sfm-") as name:
        folder = Path(name)
        if configuration is None:
            title, planned = REFERENCE, False
            calls: list[tuple[Callable[..., None], tuple[Any, ...]]] = [
                (step, (scene.manifest, folder, threads))
                for step in (reference_features, reference_matches, reference_mapping)
            ]
        else:
            title, planned = configuration.name, configuration.planned
            calls = [
                (step, (scene.manifest, configuration.config, folder, threads))
                for step in (our_features, our_matches, our_mapping)
            ]
        costs, failure = {}, ""
        for step, (function, arguments) in zip(STEPS, calls, strict=True):
            try:
                costs[step] = run_isolated(cost_of, function, arguments)
            except UserError as refusal:
                failure = refusal.what
                break
        model = folder / "sparse" / "0"
        if failure or not model.is_dir():
            return Run(scene.name, title, planned, costs, 0, None, failure or "no model")
        error = pose_error(read_model(model), scene.truth)
        registered = len(read_model(model).images)
        return Run(scene.name, title, planned, costs, registered, error)


# --- the steps, each in a separate process ------------------------------------------------


def cost_of(step: Callable[..., None], arguments: tuple[Any, ...]) -> Cost:
    """Run ``step`` in this process, which does nothing else, and report its cost."""
    # Libraries are imported before timing. cv2 comes first (see isolate).
    if step is our_features:
        import pipeline.sfm.sift
    else:
        import pipeline.sfm.mapping

        pipeline.sfm.mapping.quiet_colmap()
    before = _used()
    step(*arguments)
    after = _used()
    return Cost(after - before, peak_memory_mb())


def _used() -> float:
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(u.ru_utime + u.ru_stime for u in map(resource.getrusage, kinds))


def our_features(manifest: Manifest, config: Config, folder: Path, threads: int) -> None:
    """Do what stages/features.py does."""
    from pipeline.sfm.features import extract_features

    extract_features(
        manifest, config.features, folder / "features", cache=folder / "cache", threads=threads
    )


def our_matches(manifest: Manifest, config: Config, folder: Path, threads: int) -> None:
    """Do what stages/matches.py does."""
    from pipeline.sfm.matching import MatchingScene, match_features
    from pipeline.sfm.second_look import SecondLook

    scene = MatchingScene(manifest, folder / "features", config.sfm, config.seed)
    out, cache = folder / "matches", folder / "cache"
    look = SecondLook(config.features, cache, out / "features")
    match_features(
        scene, config.matches, out / "database.db", cache=cache, threads=threads, look=look
    )


def our_mapping(manifest: Manifest, config: Config, folder: Path, threads: int) -> None:
    """Do what stages/sfm.py does."""
    from pipeline.sfm.mapping import reconstruct

    database = folder / "matches" / "database.db"
    reconstruct(manifest, database, config.sfm, seed=config.seed).write(folder)


def reference_features(manifest: Manifest, folder: Path, threads: int) -> None:
    """Extract features with pycolmap's defaults, except for the threads, and with a single camera
    if our scan finds one."""
    import pycolmap

    photo = manifest.photos[0]
    kinds = {(p.camera_group, p.width, p.height) for p in manifest.photos}
    pycolmap.extract_features(
        folder / "database.db",
        photo.path.removesuffix(photo.name),
        image_names=[p.name for p in manifest.photos],
        camera_mode=pycolmap.CameraMode.SINGLE if len(kinds) == 1 else pycolmap.CameraMode.AUTO,
        extraction_options=pycolmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False),
        device=pycolmap.Device.cpu,
    )


def reference_matches(manifest: Manifest, folder: Path, threads: int) -> None:
    """Match all pairs and verify them."""
    import pycolmap

    options = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    pycolmap.match_exhaustive(
        folder / "database.db", matching_options=options, device=pycolmap.Device.cpu
    )


def reference_mapping(manifest: Manifest, folder: Path, threads: int) -> None:
    """Map incrementally, and write the model with the most images."""
    import pycolmap

    photo = manifest.photos[0]
    options = pycolmap.IncrementalPipelineOptions(num_threads=threads)
    models = pycolmap.incremental_mapping(
        folder / "database.db", photo.path.removesuffix(photo.name), folder / "models", options
    )
    if models:
        target = folder / "sparse" / "0"
        target.mkdir(parents=True)
        max(models.values(), key=lambda m: m.num_reg_images()).write_binary(target)
