"""SIFT keypoints of all photographs of a scene, cached photograph by photograph."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.config import schema
from pipeline.runtime.progress import Progress
from pipeline.scene.manifest import Manifest, Photo
from pipeline.sfm.isolate import run_isolated
from pipeline.sfm.keypoints import Keypoints, keypoint_file

# Part of the cache key: raise it whenever the same photograph would give other keypoints.
ALGORITHM_VERSION = 2

# Fewer keypoints than this seldom carry a verified pair (15 inliers after a ratio test).
FEW_FEATURES = 100


@dataclass(frozen=True)
class FeatureReport:
    """Attributes:
    counts: photograph's name -> number of keypoints.
    num_cached: photographs whose keypoints were found in the cache.
    decisions, warnings: for people.
    """

    counts: dict[str, int]
    num_cached: int
    decisions: list[str]
    warnings: list[str]


def extract_features(
    manifest: Manifest, config: schema.Features, out: Path, *, cache: Path, threads: int
) -> FeatureReport:
    """Write the keypoints of each photograph to ``out`` (see ``keypoint_file``).

    The bits do not depend on ``threads``, nor on what the cache holds.

    Args:
        cache: folder that may outlive this scene's results. What this call did not use is dropped
            from it once that is more than what it did.

    Raises:
        UserError: a photograph or mask cannot be read, or changed since it was inspected.
    """
    out.mkdir(parents=True, exist_ok=True)
    cache.mkdir(parents=True, exist_ok=True)
    keys = {photo.name: _cache_key(photo, config) for photo in manifest.photos}
    absent = [p for p in manifest.photos if not (cache / f"{keys[p.name]}.npz").exists()]
    # One of each: copies of a photograph have one key, and would write one file at once.
    missing = list({keys[photo.name]: photo for photo in absent}.values())
    if missing:
        progress = Progress("extracting features", len(missing), "photographs")
        extract = _extract_colmap if config.backend == "colmap" else _extract_opencv
        extract(
            missing,
            config,
            {p.name: cache / f"{keys[p.name]}.npz" for p in missing},
            threads,
            progress,
        )
    counts = {}
    for photo in manifest.photos:
        source = cache / f"{keys[photo.name]}.npz"
        target = keypoint_file(out, photo.name)
        # A copy: damage to a stage's output must not reach the cache.
        shutil.copyfile(source, target)
        counts[photo.name] = len(Keypoints.read(target))
    _prune(cache, {f"{key}.npz" for key in keys.values()})
    num_cached = len(manifest.photos) - len(absent)
    median = int(np.median(list(counts.values()))) if counts else 0
    return FeatureReport(
        counts=counts,
        num_cached=num_cached,
        decisions=[
            f"SIFT by {config.backend}: a median of {median} keypoints in each of "
            f"{len(counts)} photographs"
        ],
        warnings=[
            f"{name}: only {count} features"
            for name, count in counts.items()
            if count < FEW_FEATURES
        ],
    )


def _cache_key(photo: Photo, config: schema.Features) -> str:
    """Extraction compares the bytes it decodes with the digests that are in the key."""
    facts = {
        "photo": photo.digest,
        "mask": photo.mask_digest,
        "config": config.model_dump(mode="json"),
        "version": ALGORITHM_VERSION,
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def _prune(cache: Path, used: set[str]) -> None:
    others = [file for file in cache.glob("*.npz") if file.name not in used]
    if len(others) > len(used):
        for file in others:
            file.unlink()


def _extract_opencv(
    photos: list[Photo],
    config: schema.Features,
    targets: dict[str, Path],
    threads: int,
    progress: Progress,
) -> None:
    import cv2

    from pipeline.sfm import sift

    def extract(photo: Photo) -> None:
        picture = sift.Picture(photo, config.max_long_side_px)
        sift.detect(picture, config.max_features).write(targets[photo.name])

    # A thread a photograph (OpenCV lets go of the interpreter), none inside: the same bits
    # for any number of them.
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with ThreadPoolExecutor(max_workers=max(1, threads)) as pool:
            try:
                for _ in pool.map(extract, photos):
                    progress.advance()
            except BaseException:
                # One bad photograph: do not go through the others first.
                pool.shutdown(cancel_futures=True)
                raise
    finally:
        cv2.setNumThreads(before)


def _extract_colmap(
    photos: list[Photo],
    config: schema.Features,
    targets: dict[str, Path],
    threads: int,
    progress: Progress,
) -> None:
    """COLMAP's extractor, on the same grey pictures. It knows no limit on the number of
    features but keeps whole octaves, so the largest ones are kept here."""
    from pipeline.sfm import sift

    batch = max(8, 4 * threads)
    for start in range(0, len(photos), batch):
        chunk = photos[start : start + batch]
        with tempfile.TemporaryDirectory(prefix="splatmake-sift-") as folder:
            pictures = {}
            for index, photo in enumerate(chunk):
                picture = sift.Picture(photo, config.max_long_side_px)
                sift.write_grey(picture, str(Path(folder) / f"{index:06d}.png"))
                pictures[photo.name] = picture
            found = run_isolated(_colmap_sift, Path(folder), config.max_features, threads)
            for index, photo in enumerate(chunk):
                keypoints, descriptors = found[f"{index:06d}.png"]
                picture = pictures[photo.name]
                if picture.usable is not None:
                    at = np.floor(keypoints[:, :2]).astype(np.int64)
                    height, width = picture.usable.shape
                    at = np.clip(at, 0, [width - 1, height - 1])
                    keep = picture.usable[at[:, 1], at[:, 0]] > 0
                    keypoints, descriptors = keypoints[keep], descriptors[keep]
                table = keypoints.astype(np.float64)
                strongest = np.argsort(-table[:, 2], kind="stable")[: config.max_features]
                table = table[strongest]
                picture.finish(
                    table[:, :2], table[:, 2], table[:, 3], descriptors[strongest]
                ).write(targets[photo.name])
        progress.advance(len(chunk))


def _colmap_sift(
    folder: Path, max_features: int, threads: int
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Picture's name -> keypoints (F, 4) x, y, scale, orientation and descriptors (F, 128)."""
    import pycolmap

    from pipeline.sfm.quiet import quiet_colmap

    quiet_colmap()
    path = folder / "features.db"
    options = pycolmap.FeatureExtractionOptions(num_threads=threads)
    options.sift.max_num_features = max_features
    pycolmap.extract_features(path, folder, extraction_options=options, device=pycolmap.Device.cpu)
    with pycolmap.Database.open(path) as database:
        found = {}
        for image in database.read_all_images():
            matrix = database.read_keypoints(image.image_id)
            if matrix.shape[1] == 6:  # x, y, a11, a12, a21, a22
                shape = matrix[:, 2:].reshape(-1, 2, 2)
                scale = np.hypot(shape[:, 0, 0], shape[:, 1, 0])
                angle = np.arctan2(shape[:, 1, 0], shape[:, 0, 0])
                matrix = np.column_stack([matrix[:, :2], scale, angle])
            data = database.read_descriptors(image.image_id).data
            found[image.name] = (matrix[:, :4], np.asarray(data).reshape(-1, 128))
    return found
