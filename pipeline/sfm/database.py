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
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.config import settled
from pipeline.runtime.progress import Progress
from pipeline.runtime.record import file_digest
from pipeline.scene.manifest import Manifest, Photo
from pipeline.sfm.fisheye import is_uncalibrated, with_prior
from pipeline.sfm.keypoints import Keypoints, keypoint_file
from pipeline.sfm.nearest import match_descriptors
from pipeline.sfm.pair_cache import PairCache
from pipeline.sfm.pairs import Pair

# COLMAP's default focal length over the longer side without a prior (about 45 degrees).
DEFAULT_FOCAL_FACTOR = 1.2

# Part of a pair's cache key: increase it when a change of the code changes matches.
ALGORITHM_VERSION = 1

# Maximum number of RANSAC trials of two-view geometry: enough for a fundamental matrix at an inlier
# ratio of 40%. COLMAP's default of 10000 costs five times as much for pairs without overlap.
MAX_TRIALS = 2000

# Number of photographs whose keypoints are in memory at a time, about 700 KB each.
CACHED_KEYPOINT_FILES = 200
# Number of pairs written to the cache at a time; an interrupted run loses at most these.
BATCH_PAIRS = 256


@dataclass(frozen=True)
class MatchingSettings:
    """Settings of matching and two-view verification.

    Attributes:
        max_ratio: of Lowe's ratio test.
        min_inliers: smallest number of inliers of a verified pair.
        seed: of RANSAC.
    """

    max_ratio: float
    min_inliers: int
    seed: int


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
    cameras: Sequence[pycolmap.Camera],
    images: Sequence[tuple[int, str, int]],
    features: Path,
    pairs: Sequence[Pair],
    settings: MatchingSettings,
    *,
    cache: Path | None = None,
    matched: Iterable[tuple[Path, Sequence[Pair]]] = (),
    threads: int = 1,
) -> int:
    """Match and verify pairs and write the database to ``path``.

    The file depends neither on ``threads`` nor on the content of the cache nor on what is already
    ``matched``: pairs are computed independently and written in order.

    Args:
        images: (image id, name, camera id), sorted by id.
        features: folder of keypoint files.
        pairs: indices into ``images``, the smaller one first.
        cache: folder for results of pairs that outlives the call; None for a temporary one.
        matched: files of ``match_pairs`` with their pairs, which are added to the cache.

    Returns:
        The number of pairs found in the cache.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="matching-", dir=path.parent) as folder:
        store = Path(folder) if cache is None else cache
        store.mkdir(parents=True, exist_ok=True)
        inputs = _MatchingInputs(cameras, images, features)
        keys = inputs.keys(pairs, settings)
        with closing(PairCache(store)) as results:
            for file, part in matched:
                results.add(file, inputs.keys(part, settings))
            num_cached = _match_missing(inputs, keys, settings, results, Path(folder), threads)
            path.unlink(missing_ok=True)
            inputs.write(path)
            results.copy_to(path, keys)
            results.prune(set(keys.values()))
    return num_cached


def match_pairs(
    path: Path,
    cameras: Sequence[pycolmap.Camera],
    images: Sequence[tuple[int, str, int]],
    features: Path,
    pairs: Sequence[Pair],
    settings: MatchingSettings,
    *,
    cache: Path,
    scratch: Path,
    threads: int = 1,
) -> tuple[int, int]:
    """Match and verify some of a scene's pairs and write them to ``path``, a COLMAP database
    without images. ``build_database`` adds them to the scene's database.

    Args:
        cache: as of ``build_database``; it is only read.
        scratch: folder of the results until they are complete. A call that is repeated finds those
            of a process that was killed.

    Returns:
        The numbers of pairs that were found in the cache, and of verified pairs.
    """
    for folder in (path.parent, scratch):
        folder.mkdir(parents=True, exist_ok=True)
    inputs = _MatchingInputs(cameras, images, features)
    keys = inputs.keys(pairs, settings)
    with closing(PairCache(scratch)) as results:
        results.add_known(cache, keys.values())
        num_cached = _match_missing(inputs, keys, settings, results, scratch, threads)
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
            camera = cameras[camera_id]
            if camera.is_spherical():
                continue
            side = max(camera.width, camera.height)
            shared = pycolmap.Camera.create_from_model_name(
                camera_id,
                camera.model_name,
                DEFAULT_FOCAL_FACTOR * side,
                camera.width,
                camera.height,
            )
            database.update_camera(shared)
    # Every rig has one camera, with the same id; every frame has one image.
    moves = [(new, old) for old, new in merged.items() if new != old]
    connection = sqlite3.connect(target)
    try:
        for table, column in (("images", "camera_id"), ("frames", "rig_id")):
            statement = f"UPDATE {table} SET {column} = ? WHERE {column} = ?"
            connection.executemany(statement, moves)
        connection.executemany("UPDATE frame_data SET sensor_id = ? WHERE sensor_id = ?", moves)
        unused = [(old,) for _, old in moves]
        connection.executemany("DELETE FROM rigs WHERE rig_id = ?", unused)
        connection.executemany("DELETE FROM cameras WHERE camera_id = ?", unused)
        connection.commit()
    finally:
        connection.close()
    return True


class _MatchingInputs:
    """Cameras, images and keypoints to match; keypoints are read on demand."""

    def __init__(
        self,
        cameras: Sequence[pycolmap.Camera],
        images: Sequence[tuple[int, str, int]],
        features: Path,
    ):
        self._cameras, self._images = cameras, images
        self._verified = {
            camera.camera_id: with_prior(camera) if is_uncalibrated(camera) else camera
            for camera in cameras
        }
        self._camera_of = {image_id: camera_id for image_id, _, camera_id in images}
        self._file = {image_id: keypoint_file(features, name) for image_id, name, _ in images}
        self._digest: dict[int, str] = {}
        self.keypoints = lru_cache(maxsize=CACHED_KEYPOINT_FILES)(self._read)

    def camera(self, image_id: int) -> pycolmap.Camera:
        """The camera as pairs are verified with it."""
        return self._verified[self._camera_of[image_id]]

    def _read(self, image_id: int) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """(F, 2) positions and (F, 128) descriptors."""
        found = Keypoints.read(self._file[image_id])
        return found.xy.astype(np.float64), found.descriptors

    def keys(self, pairs: Sequence[Pair], settings: MatchingSettings) -> dict[tuple[int, int], int]:
        """Image ids of each pair, given by the indices of its images -> its cache key."""
        ids = [(self._images[i][0], self._images[j][0]) for i, j in pairs]
        return {pair: self._key(pair, settings) for pair in ids}

    def _key(self, pair: tuple[int, int], settings: MatchingSettings) -> int:
        """Cache key of a pair: a hash of everything the result depends on, 63 bits (a positive
        SQLite integer)."""
        facts = [ALGORITHM_VERSION, MAX_TRIALS, pycolmap.__version__, asdict(settings)]
        for image_id in pair:
            c = self.camera(image_id)
            if image_id not in self._digest:
                self._digest[image_id] = file_digest(self._file[image_id])
            facts += [self._digest[image_id], c.model_name, c.width, c.height]
            facts += [c.params.tolist(), c.has_prior_focal_length]
        digest = hashlib.sha256(repr(facts).encode()).digest()
        return int.from_bytes(digest[:8], "big") >> 1

    def write(self, path: Path) -> None:
        """Write a database of the cameras, images and keypoints."""
        with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
            for camera in self._cameras:
                database.write_camera(camera, use_camera_id=True)
                rig = pycolmap.Rig(rig_id=camera.camera_id)
                rig.add_ref_sensor(camera.sensor_id)
                database.write_rig(rig, use_rig_id=True)
            for image_id, name, camera_id in self._images:
                image = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id)
                database.write_image(image, use_image_id=True)
                frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
                frame.add_data_id(image.data_id)
                database.write_frame(frame, use_frame_id=True)
                found = Keypoints.read(self._file[image_id])
                table = np.column_stack([found.xy, found.scale, found.orientation])
                database.write_keypoints(image_id, table.astype(np.float32).reshape(-1, 4))


def _match_missing(
    inputs: _MatchingInputs,
    keys: Mapping[tuple[int, int], int],
    settings: MatchingSettings,
    cache: PairCache,
    folder: Path,
    threads: int,
) -> int:
    """Match and verify the pairs (image ids -> key) that the cache lacks and add them to it.

    Returns:
        The number of pairs that it has had already.
    """
    missing = [pair for pair, key in keys.items() if not cache.has(key)]
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
                results = pool.map(lambda pair: _match_pair(inputs, pair, settings), batch)
                for (first, second), (matches, geometry) in zip(batch, results, strict=True):
                    database.write_matches(first, second, matches)
                    database.write_two_view_geometry(first, second, geometry)
                    progress.advance()
            cache.add(path, {pair: keys[pair] for pair in batch})
    return len(keys) - len(missing)


def _match_pair(
    inputs: _MatchingInputs, pair: tuple[int, int], settings: MatchingSettings
) -> tuple[NDArray[np.uint32], pycolmap.TwoViewGeometry]:
    """(M, 2) matches, and their two-view geometry, which is empty if the pair is not verified."""
    (xy_a, descriptors_a), (xy_b, descriptors_b) = (inputs.keypoints(i) for i in pair)
    matches = match_descriptors(descriptors_a, descriptors_b, settings.max_ratio)
    if len(matches) < settings.min_inliers:
        return matches, pycolmap.TwoViewGeometry()
    options = pycolmap.TwoViewGeometryOptions(min_num_inliers=settings.min_inliers)
    options.ransac.random_seed = settings.seed
    options.ransac.max_num_trials = MAX_TRIALS
    # A geometry with fewer inliers would be rejected below.
    options.ransac.min_inlier_ratio = settings.min_inliers / len(matches)
    geometry = pycolmap.estimate_two_view_geometry(
        inputs.camera(pair[0]), xy_a, inputs.camera(pair[1]), xy_b, matches, options
    )
    if len(geometry.inlier_matches) < settings.min_inliers:
        return matches, pycolmap.TwoViewGeometry()
    return matches, geometry
