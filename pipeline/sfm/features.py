"""Feature extraction for all photographs of a scene, with a cache for each photograph."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.config import settled
from pipeline.runtime.atomic import link_or_copy
from pipeline.runtime.counters import Report
from pipeline.runtime.isolate import run_isolated
from pipeline.runtime.machine import threads_within
from pipeline.runtime.progress import Progress
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.views import view_size
from pipeline.sfm.chunks import chunk
from pipeline.sfm.counters import FeaturesCounters
from pipeline.sfm.keypoints import Keypoints, keypoint_file

# Part of the cache key: increase it when a change of the code changes keypoints.
ALGORITHM_VERSION = 3

# Of OpenCV, which divides it by its 3 octave layers; COLMAP's peak threshold is that quotient. Half
# of OpenCV's default: weakly textured scenes need weak keypoints, and the number is limited anyway.
# At the low one OpenCV finds as many keypoints as COLMAP does at the other.
CONTRAST_THRESHOLD, LOW_CONTRAST_THRESHOLD = 0.02, 0.01
OCTAVE_LAYERS = 3

# Peak memory per pixel of a photograph while it is decoded, and of the image that SIFT is detected
# in: its scale space begins with twice the size.
_PHOTO_BYTES, _SIFT_BYTES = 7.0, 250.0

# What the progress counts.
PROGRESS = "extracting features", "photographs"

# With fewer keypoints than this, a photograph rarely has a verified pair, and a warning is given.
FEW_FEATURES = 100


def extract_features(
    manifest: Manifest, config: settled.Features, out: Path, *, cache: Path, threads: int
) -> Report[FeaturesCounters]:
    """Extract SIFT features of each photograph and write them to ``out`` (see ``keypoint_file``).

    The files depend neither on ``threads`` nor on the content of the cache.

    Args:
        cache: A folder for keypoints that may outlive the results. Unused files are removed if
            there are more of them than used ones.

    Raises:
        UserError: a photograph or mask cannot be read, or changed since it was inspected.
    """
    report = extract_photos(manifest.photos, config, out, cache=cache, threads=threads)
    _prune(cache, manifest, config)
    return report


def gather_features(
    manifest: Manifest,
    config: settled.Features,
    parts: Mapping[Path, FeaturesCounters],
    out: Path,
    *,
    cache: Path,
) -> Report[FeaturesCounters]:
    """Gather the keypoints of several jobs in ``out``: the same files and the same report as of
    ``extract_features``.

    Args:
        parts: The folder and the counters of each job, in order.
        cache: The folder that the jobs used.
    """
    out.mkdir(parents=True, exist_ok=True)
    counts: dict[str, int] = {}
    for number, (part, counters) in enumerate(parts.items(), start=1):
        counts |= counters.counts
        for photo in chunk(manifest.photos, number, len(parts)):
            link_or_copy(keypoint_file(part, photo.name), keypoint_file(out, photo.name))
    _prune(cache, manifest, config)
    return _report({photo.name: counts[photo.name] for photo in manifest.photos}, config)


def extract_photos(
    photos: Sequence[Photo],
    config: settled.Features,
    out: Path,
    *,
    cache: Path,
    threads: int,
    contrast_threshold: float = CONTRAST_THRESHOLD,
) -> Report[FeaturesCounters]:
    """``extract_features`` of some photographs, which removes no files from the cache. Several
    processes may do so at the same time with the same cache."""
    out.mkdir(parents=True, exist_ok=True)
    cache.mkdir(parents=True, exist_ok=True)
    keys = {photo.name: _cache_key(photo, config, contrast_threshold) for photo in photos}
    absent = [p for p in photos if not (cache / f"{keys[p.name]}.npz").exists()]
    # Use one photograph of each key: identical photographs would write the same file concurrently.
    missing = list({keys[photo.name]: photo for photo in absent}.values())
    if missing:
        extract = _extract_colmap if config.backend == "colmap" else _extract_opencv
        targets = {p.name: cache / f"{keys[p.name]}.npz" for p in missing}
        extract(missing, config, contrast_threshold, targets, threads)
    counts = {}
    for photo in photos:
        source = cache / f"{keys[photo.name]}.npz"
        target = keypoint_file(out, photo.name)
        # A copy, not a link: changes of a stage's output must not affect the cache.
        shutil.copyfile(source, target)
        counts[photo.name] = len(Keypoints.read(target))
    return _report(counts, config, num_cached=len(photos) - len(absent))


def _report(
    counts: dict[str, int], config: settled.Features, num_cached: int = 0
) -> Report[FeaturesCounters]:
    median = int(np.median(list(counts.values()))) if counts else 0
    return Report(
        counters=FeaturesCounters(counts=counts),
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


def _cache_key(
    photo: Photo, config: settled.Features, contrast_threshold: float = CONTRAST_THRESHOLD
) -> str:
    """Hash of everything that determines the keypoints. Extraction compares the files that it
    decodes with the digests in the key."""
    facts = {
        "photo": photo.digest,
        "mask": photo.mask_digest,
        "config": config.model_dump(mode="json", exclude={"photos_per_job"}),
        "contrast_threshold": contrast_threshold,
        "version": ALGORITHM_VERSION,
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def _prune(cache: Path, manifest: Manifest, config: settled.Features) -> None:
    used = {f"{_cache_key(photo, config)}.npz" for photo in manifest.photos}
    unused = [file for file in cache.glob("*.npz") if file.name not in used]
    if len(unused) > len(used):
        for file in unused:
            file.unlink()


def _extract_opencv(
    photos: list[Photo],
    config: settled.Features,
    contrast_threshold: float,
    targets: dict[str, Path],
    threads: int,
) -> None:
    from pipeline.photos.threads import for_each
    from pipeline.sfm import sift

    sizes = [(photo.width, photo.height) for photo in photos]
    largest = max(width * height for width, height in sizes)
    small = [view_size(width, height, config.max_long_side_px) for width, height in sizes]
    detection = max(width * height for width, height in small)
    threads = threads_within(threads, max(_PHOTO_BYTES * largest, _SIFT_BYTES * detection))

    def extract(photo: Photo) -> None:
        picture = sift.DetectionImage(photo, config.max_long_side_px)
        found = sift.detect(picture, config.max_features, contrast_threshold)
        found.write(targets[photo.name])

    for_each(extract, photos, threads, *PROGRESS)


def _extract_colmap(
    photos: list[Photo],
    config: settled.Features,
    contrast_threshold: float,
    targets: dict[str, Path],
    threads: int,
) -> None:
    """Extract with COLMAP's SIFT from the same grey images. COLMAP limits the number of features by
    whole octaves, so the ones of the largest scales are selected here."""
    from pipeline.sfm import sift

    batch = max(8, 4 * threads)
    progress = Progress(PROGRESS[0], len(photos), PROGRESS[1])
    for start in range(0, len(photos), batch):
        some = photos[start : start + batch]
        with tempfile.TemporaryDirectory(prefix="splatmake-sift-") as folder:
            pictures = {}
            for index, photo in enumerate(some):
                picture = sift.DetectionImage(photo, config.max_long_side_px)
                sift.write_grey(picture, str(Path(folder) / f"{index:06d}.png"))
                pictures[photo.name] = picture
            peak_threshold = contrast_threshold / OCTAVE_LAYERS
            found = run_isolated(
                _colmap_sift, Path(folder), config.max_features, peak_threshold, threads
            )
            for index, photo in enumerate(some):
                keypoints, descriptors = found[f"{index:06d}.png"]
                picture = pictures[photo.name]
                if picture.usable is not None:
                    pixel = np.floor(keypoints[:, :2]).astype(np.int64)
                    height, width = picture.usable.shape
                    pixel = np.clip(pixel, 0, [width - 1, height - 1])
                    keep = picture.usable[pixel[:, 1], pixel[:, 0]] > 0
                    keypoints, descriptors = keypoints[keep], descriptors[keep]
                table = keypoints.astype(np.float64)
                largest = np.argsort(-table[:, 2], kind="stable")[: config.max_features]
                table = table[largest]
                picture.finish(table[:, :2], table[:, 2], table[:, 3], descriptors[largest]).write(
                    targets[photo.name]
                )
        progress.advance(len(some))


def _colmap_sift(
    folder: Path, max_features: int, peak_threshold: float, threads: int
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """File name -> (F, 4) keypoints (x, y, scale, orientation) and (F, 128) descriptors."""
    import pycolmap

    from pipeline.sfm.models import quiet_colmap

    quiet_colmap()
    path = folder / "features.db"
    options = pycolmap.FeatureExtractionOptions(num_threads=threads)
    options.sift.max_num_features = max_features
    options.sift.peak_threshold = peak_threshold
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
