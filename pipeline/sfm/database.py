"""COLMAP database of a scene: cameras, images, keypoints, matches and two-view geometries.

Matching and verification are cached pair by pair.
"""

from __future__ import annotations

import hashlib
import posixpath
import shutil
import sqlite3
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.config import settled
from pipeline.runtime.progress import Progress
from pipeline.runtime.record import file_digest
from pipeline.scene.manifest import Manifest, Photo
from pipeline.sfm.keypoints import Keypoints, keypoint_file
from pipeline.sfm.models import DEFAULT_FOCAL_FACTOR, is_uncalibrated, uncalibrated, with_prior
from pipeline.sfm.nearest import match_descriptors
from pipeline.sfm.pair_cache import PairCache
from pipeline.sfm.pairs import Pair

# Part of a pair's cache key: increase it when a change of the code changes matches.
ALGORITHM_VERSION = 1

# Maximum number of RANSAC trials of two-view geometry: enough for a fundamental matrix at an inlier
# ratio of 40%. COLMAP's default of 10000 costs five times as much for pairs without overlap.
MAX_TRIALS = 2000

# Number of photographs whose keypoints are in memory at a time, about 700 KB each.
CACHED_KEYPOINT_FILES = 200
# Number of pairs written to the cache at a time; an interrupted run loses at most these.
BATCH_PAIRS = 256


@dataclass(frozen=True, eq=False)
class MatchingInputs:
    """The photographs whose pairs are matched and verified. Keypoints are read on demand.

    Attributes:
        cameras: The cameras of the photographs.
        images: (image id, name, camera id) of each photograph, sorted by id.
        features: The folder of the keypoint files.
        max_ratio: The largest ratio of Lowe's ratio test.
        min_inliers: The smallest number of inliers of a verified pair.
        seed: The seed of RANSAC.
    """

    cameras: Sequence[pycolmap.Camera]
    images: Sequence[tuple[int, str, int]]
    features: Path
    max_ratio: float
    min_inliers: int
    seed: int

    @cached_property
    def _camera_of(self) -> dict[int, pycolmap.Camera]:
        """Image id -> the camera that its pairs are verified with."""
        verified = {c.camera_id: with_prior(c) if is_uncalibrated(c) else c for c in self.cameras}
        return {image_id: verified[camera_id] for image_id, _, camera_id in self.images}

    @cached_property
    def keypoints(self) -> Callable[[int], Keypoints]:
        """Image id -> the keypoints of the photograph."""
        return lru_cache(CACHED_KEYPOINT_FILES)(
            lambda image_id: Keypoints.read(self.file(image_id))
        )

    @cached_property
    def _digest(self) -> Callable[[int], str]:
        return cache(lambda image_id: file_digest(self.file(image_id)))

    @cached_property
    def _names(self) -> dict[int, str]:
        return {image_id: name for image_id, name, _ in self.images}

    def file(self, image_id: int) -> Path:
        """The keypoint file of a photograph."""
        return keypoint_file(self.features, self._names[image_id])

    def colors(self) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """The id of each image and the (F, 3) colours of its keypoints, one image at a time."""
        return ((i, Keypoints.read(self.file(i)).rgb) for i, _, _ in self.images)

    def keys(self, pairs: Sequence[Pair]) -> dict[tuple[int, int], int]:
        """Image ids of each pair, given by the indices of its images -> its cache key."""
        ids = [(self.images[i][0], self.images[j][0]) for i, j in pairs]
        return {pair: self._key(pair) for pair in ids}

    def _key(self, pair: tuple[int, int]) -> int:
        """Cache key of a pair: a hash of everything the result depends on, 63 bits (a positive
        SQLite integer)."""
        options = {"max_ratio": self.max_ratio, "min_inliers": self.min_inliers, "seed": self.seed}
        facts = [ALGORITHM_VERSION, MAX_TRIALS, pycolmap.__version__, options]
        for image_id in pair:
            c = self._camera_of[image_id]
            facts += [self._digest(image_id), c.model_name, c.width, c.height]
            facts += [c.params.tolist(), c.has_prior_focal_length]
        digest = hashlib.sha256(repr(facts).encode()).digest()
        return int.from_bytes(digest[:8], "big") >> 1

    def match(self, pair: tuple[int, int]) -> tuple[NDArray[np.uint32], pycolmap.TwoViewGeometry]:
        """(M, 2) matches of two images, and their two-view geometry, which is empty if the pair is
        not verified."""
        a, b = (self.keypoints(image_id) for image_id in pair)
        matches = match_descriptors(a.descriptors, b.descriptors, self.max_ratio)
        if len(matches) < self.min_inliers:
            return matches, pycolmap.TwoViewGeometry()
        options = pycolmap.TwoViewGeometryOptions(min_num_inliers=self.min_inliers)
        options.ransac.random_seed = self.seed
        options.ransac.max_num_trials = MAX_TRIALS
        # A geometry with fewer inliers would be rejected below.
        options.ransac.min_inlier_ratio = self.min_inliers / len(matches)
        camera_a, camera_b = (self._camera_of[image_id] for image_id in pair)
        geometry = pycolmap.estimate_two_view_geometry(
            *(camera_a, a.xy.astype(np.float64), camera_b, b.xy.astype(np.float64)),
            *(matches, options),
        )
        if len(geometry.inlier_matches) < self.min_inliers:
            return matches, pycolmap.TwoViewGeometry()
        return matches, geometry

    def write(self, path: Path) -> None:
        """Write a database of the cameras, images and keypoints."""
        path.unlink(missing_ok=True)
        with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
            for camera in self.cameras:
                database.write_camera(camera, use_camera_id=True)
                rig = pycolmap.Rig(rig_id=camera.camera_id)
                rig.add_ref_sensor(camera.sensor_id)
                database.write_rig(rig, use_rig_id=True)
            for image_id, name, camera_id in self.images:
                image = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id)
                database.write_image(image, use_image_id=True)
                frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
                frame.add_data_id(image.data_id)
                database.write_frame(frame, use_frame_id=True)
                found = Keypoints.read(self.file(image_id))
                table = np.column_stack([found.xy, found.scale, found.orientation])
                database.write_keypoints(image_id, table.astype(np.float32).reshape(-1, 4))


def plan_cameras(
    manifest: Manifest, sfm: settled.Sfm
) -> tuple[list[pycolmap.Camera], dict[str, int]]:
    """Group the photographs into cameras.

    ``sfm.share_cameras`` decides which photographs share a camera; photographs of different sizes
    never do, and panoramas only with panoramas. The focal length prior of a camera is the median
    of its photographs' EXIF priors; a panorama's camera has no parameters to estimate.

    Returns:
        The cameras (ids from 1, in order of their first photograph) and photograph name -> camera
        id.
    """
    members: dict[tuple[tuple[str, ...], int, int, str], list[Photo]] = defaultdict(list)
    for photo in manifest.photos:
        group = _sharing(photo, sfm.share_cameras)
        model: str = "EQUIRECTANGULAR" if photo.panorama else sfm.camera_model
        members[group, photo.width, photo.height, model].append(photo)
    cameras, camera_of = [], {}
    for index, ((_, width, height, model), photos) in enumerate(members.items(), start=1):
        priors = [p.focal_px for p in photos if p.focal_px]
        guess = DEFAULT_FOCAL_FACTOR * max(width, height)
        if "FISHEYE" in model:
            guess = 0.5 * max(width, height)
        focal = float(np.median(priors)) if priors else guess
        camera = pycolmap.Camera.create_from_model_name(index, model, focal, width, height)
        # View graph calibration leaves cameras with a prior as they are.
        camera.has_prior_focal_length = bool(priors) or camera.is_spherical()
        cameras.append(camera)
        camera_of.update({p.name: index for p in photos})
    return cameras, camera_of


def _sharing(photo: Photo, share: str) -> tuple[str, ...]:
    """Equal for photographs of one size that share a camera."""
    match share:
        case "single":
            return ()
        case "image":
            return (photo.name,)
        case "folder":
            return (posixpath.dirname(photo.name), photo.camera_group)
        case _:
            return (photo.camera_group,)


def build_database(
    path: Path,
    inputs: MatchingInputs,
    pairs: Sequence[Pair],
    *,
    cache: Path | None = None,
    matched: Iterable[tuple[Path, Sequence[Pair]]] = (),
    threads: int = 1,
) -> int:
    """Match and verify pairs and write the database to ``path``.

    The file depends neither on ``threads`` nor on the content of the cache nor on what is already
    ``matched``: pairs are computed independently and written in order.

    Args:
        pairs: Indices into the images, the smaller one first.
        cache: A folder for results of pairs that outlives the call; None for a temporary one.
        matched: The files of ``match_pairs`` with their pairs, which are added to the cache.

    Returns:
        The number of pairs found in the cache.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="matching-", dir=path.parent) as folder:
        store = Path(folder) if cache is None else cache
        store.mkdir(parents=True, exist_ok=True)
        keys = inputs.keys(pairs)
        with closing(PairCache(store)) as results:
            for file, part in matched:
                results.add(file, inputs.keys(part))
            num_cached = _match_missing(inputs, keys, results, Path(folder), threads)
            inputs.write(path)
            results.copy_to(path, keys)
            results.prune(set(keys.values()))
    return num_cached


def match_pairs(
    path: Path,
    inputs: MatchingInputs,
    pairs: Sequence[Pair],
    *,
    cache: Path,
    scratch: Path,
    threads: int = 1,
) -> tuple[int, int]:
    """Match and verify some of a scene's pairs and write them to ``path``, a COLMAP database
    without images. ``build_database`` adds them to the scene's database.

    Args:
        pairs: Indices into the images, the smaller one first.
        cache: The folder that ``build_database`` uses; it is only read.
        scratch: A folder for the results until they are complete. A call that is repeated finds
            those of a process that was killed.

    Returns:
        The numbers of pairs that were found in the cache, and of verified pairs.
    """
    for folder in (path.parent, scratch):
        folder.mkdir(parents=True, exist_ok=True)
    keys = inputs.keys(pairs)
    with closing(PairCache(scratch)) as results:
        results.add_known(cache, keys.values())
        num_cached = _match_missing(inputs, keys, results, scratch, threads)
        path.unlink(missing_ok=True)
        pycolmap.Database.open(path).close()
        results.copy_to(path, keys)
    with pycolmap.Database.open(path) as database:
        _, inliers = database.read_two_view_geometry_num_inliers()
    return num_cached, sum(count > 0 for count in inliers)


def verified_inliers(path: Path) -> dict[tuple[str, str], int]:
    """Names of two images -> number of verified matches, for the pairs that have any."""
    with pycolmap.Database.open(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        ids, counts = database.read_two_view_geometry_num_inliers()
    found = {}
    for pair_id, count in zip(ids, counts, strict=True):
        if count > 0:
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            found[names[first], names[second]] = count
    return dict(sorted(found.items()))


def share_cameras_by_size(source: Path, target: Path) -> bool:
    """Copy a database so that photographs of the same size share a camera without a focal prior.

    Returns:
        False, without writing a copy, if they share their cameras already.
    """
    with pycolmap.Database.open(source) as database:
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        used = {image.camera_id for image in database.read_all_images()}
    shared_ids: dict[tuple[int, int, bool], int] = {}
    merged = {}
    for camera_id in sorted(used):
        camera = cameras[camera_id]
        key = (camera.width, camera.height, camera.is_spherical())
        merged[camera_id] = shared_ids.setdefault(key, camera_id)
    if len(shared_ids) == len(used):
        return False
    shutil.copyfile(source, target)
    with pycolmap.Database.open(target) as database:
        for camera_id in shared_ids.values():
            if not cameras[camera_id].is_spherical():
                database.update_camera(uncalibrated(cameras[camera_id]))
    # Every rig has one camera, with the same id; every frame has one image.
    moves = [(new, old) for old, new in merged.items() if new != old]
    unused = [(old,) for _, old in moves]
    with closing(sqlite3.connect(target)) as connection, connection:
        for table, column in (
            ("images", "camera_id"),
            ("frames", "rig_id"),
            ("frame_data", "sensor_id"),
        ):
            statement = f"UPDATE {table} SET {column} = ? WHERE {column} = ?"
            connection.executemany(statement, moves)
        for table, column in (("rigs", "rig_id"), ("cameras", "camera_id")):
            connection.executemany(f"DELETE FROM {table} WHERE {column} = ?", unused)
    return True


def _match_missing(
    inputs: MatchingInputs,
    keys: Mapping[tuple[int, int], int],
    results: PairCache,
    folder: Path,
    threads: int,
) -> int:
    """Match and verify the pairs (image ids -> key) that ``results`` lacks and add them to it.

    Returns:
        The number of pairs that it had already.
    """
    missing = [pair for pair, key in keys.items() if not results.has(key)]
    if not missing:
        return len(keys)
    progress = Progress("matching", len(missing), "pairs")
    # Threads suffice: matching and verification release the GIL.
    with ThreadPoolExecutor(max_workers=max(1, threads)) as pool:
        for start in range(0, len(missing), BATCH_PAIRS):
            batch = missing[start : start + BATCH_PAIRS]
            path = folder / "batch.db"
            path.unlink(missing_ok=True)
            with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
                matched = pool.map(inputs.match, batch)
                for (first, second), (matches, geometry) in zip(batch, matched, strict=True):
                    database.write_matches(first, second, matches)
                    database.write_two_view_geometry(first, second, geometry)
                    progress.advance()
            results.add(path, {pair: keys[pair] for pair in batch})
    return len(keys) - len(missing)
