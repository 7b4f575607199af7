"""COLMAP's database of a scene: filled from keypoint files, matched, and put in a fixed order."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from pipeline.config import schema
from pipeline.runtime.progress import Progress
from pipeline.scene.manifest import Manifest, Photo
from pipeline.sfm.keypoints import Keypoints, keypoint_file
from pipeline.sfm.pairs import Pair

# COLMAP's guess where there is no prior: a 45 degree view, about.
DEFAULT_FOCAL_FACTOR = 1.2

# Pairs matched between two lines of progress; each batch reads its descriptors anew.
BATCH_PAIRS = 200


@dataclass(frozen=True)
class MatchingSettings:
    """What one run of matching and verification needs to know."""

    max_ratio: float
    min_inliers: int
    seed: int


def plan_cameras(
    manifest: Manifest, sfm: schema.Sfm
) -> tuple[list[pycolmap.Camera], dict[str, int]]:
    """Cameras (ids from 1, in order of their first photograph) and photograph's name -> id.

    Photographs share a camera as ``sfm.share_cameras`` says, and only ever with photographs of
    the same size. The focal prior of a camera is the median of its photographs' EXIF priors.
    """
    members: dict[tuple[str, int, int], list[Photo]] = defaultdict(list)
    for photo in manifest.photos:
        group = {"single": "", "image": photo.name}.get(sfm.share_cameras, photo.camera_group)
        members[group, photo.width, photo.height].append(photo)
    model = "SIMPLE_RADIAL" if sfm.camera_model == "auto" else sfm.camera_model
    cameras, camera_of = [], {}
    for index, ((_, width, height), photos) in enumerate(members.items(), start=1):
        priors = [p.focal_px for p in photos if p.focal_px]
        guess = DEFAULT_FOCAL_FACTOR * max(width, height)
        if "FISHEYE" in model:
            guess = 0.5 * max(width, height)
        focal = float(np.median(priors)) if priors else guess
        camera = pycolmap.Camera.create_from_model_name(index, model, focal, width, height)
        camera.has_prior_focal_length = bool(priors)
        cameras.append(camera)
        camera_of.update({p.name: index for p in photos})
    return cameras, camera_of


def build_database(
    path: Path,
    cameras: Sequence[pycolmap.Camera],
    images: Sequence[tuple[int, str, int]],
    features: Path,
    pairs: Sequence[Pair],
    settings: MatchingSettings,
) -> None:
    """Write a database of matched and verified pairs to ``path``.

    The file's bytes depend on the arguments alone: what pycolmap's threads wrote in the order
    they finished is copied into a fresh file in order of its keys.

    Args:
        images: (image id, name, camera id) in order of their ids.
        features: folder of keypoint files.
        pairs: indices into ``images``.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="matching-", dir=path.parent) as folder:
        work = Path(folder) / "work.db"
        _write_images(work, cameras, images, features)
        _match(work, [(images[i][0], images[j][0]) for i, j in pairs], settings)
        path.unlink(missing_ok=True)
        _copy_sorted(work, path, {image_id: name for image_id, name, _ in images})


def verified_inliers(path: Path) -> dict[tuple[str, str], int]:
    """Names of the two images -> number of verified matches, of the pairs that have any."""
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
    """Copy a database, giving photographs of one size one camera, without a focal prior;
    False, and no copy, where they have one already."""
    with pycolmap.Database.open(source) as database:
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        used = {image.camera_id for image in database.read_all_images()}
    kept: dict[tuple[int, int], int] = {}
    merged = {}
    for camera_id in sorted(used):
        camera = cameras[camera_id]
        merged[camera_id] = kept.setdefault((camera.width, camera.height), camera_id)
    if len(kept) == len(used):
        return False
    shutil.copyfile(source, target)
    with pycolmap.Database.open(target) as database:
        for camera_id in kept.values():
            camera = cameras[camera_id]
            side = max(camera.width, camera.height)
            shared = pycolmap.Camera.create_from_model_name(
                camera_id,
                camera.model_name,
                DEFAULT_FOCAL_FACTOR * side,
                camera.width,
                camera.height,
            )
            database.update_camera(shared)
    # A rig has its camera's id, and a frame is one image.
    moves = [(new, old) for old, new in merged.items() if new != old]
    connection = sqlite3.connect(target)
    try:
        for table, column in (("images", "camera_id"), ("frames", "rig_id")):
            statement = f"UPDATE {table} SET {column} = ? WHERE {column} = ?"
            connection.executemany(statement, moves)
        connection.executemany("UPDATE frame_data SET sensor_id = ? WHERE sensor_id = ?", moves)
        gone = [(old,) for _, old in moves]
        connection.executemany("DELETE FROM rigs WHERE rig_id = ?", gone)
        connection.executemany("DELETE FROM cameras WHERE camera_id = ?", gone)
        connection.commit()
    finally:
        connection.close()
    return True


def _write_images(
    path: Path,
    cameras: Sequence[pycolmap.Camera],
    images: Sequence[tuple[int, str, int]],
    features: Path,
) -> None:
    """Images are named by their ids: pycolmap's pair lists cannot say a name with a space."""
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for camera in cameras:
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=camera.camera_id)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for image_id, name, camera_id in images:
            image = pycolmap.Image(name=str(image_id), camera_id=camera_id, image_id=image_id)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            found = Keypoints.read(keypoint_file(features, name))
            table = np.column_stack([found.xy, found.scale, found.orientation])
            database.write_keypoints(image_id, table.astype(np.float32).reshape(-1, 4))
            database.write_descriptors(
                image_id,
                pycolmap.FeatureDescriptors(
                    pycolmap.FeatureExtractorType.SIFT, found.descriptors.reshape(-1, 128)
                ),
            )


def _match(path: Path, pairs: Sequence[tuple[int, int]], settings: MatchingSettings) -> None:
    # Not more: with two threads pycolmap 4.2 loses the matches of some pairs once in many runs.
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    matching.sift.max_ratio = settings.max_ratio
    verification = pycolmap.TwoViewGeometryOptions(min_num_inliers=settings.min_inliers)
    verification.ransac.random_seed = settings.seed
    progress = Progress("matching", len(pairs), "pairs")
    pairing = pycolmap.ImportedPairingOptions(match_list_path=path.with_name("pairs.txt"))
    for start in range(0, len(pairs), BATCH_PAIRS):
        batch = pairs[start : start + BATCH_PAIRS]
        lines = "".join(f"{first} {second}\n" for first, second in batch)
        path.with_name("pairs.txt").write_text(lines)
        pycolmap.match_image_pairs(path, matching, pairing, verification, pycolmap.Device.cpu)
        progress.advance(len(batch))


def _copy_sorted(source: Path, target: Path, names: dict[int, str]) -> None:
    """Copy all tables but the descriptors, each in order of its first columns, and give the
    images their names."""
    pycolmap.Database.open(target).close()
    connection = sqlite3.connect(target)
    try:
        connection.execute("ATTACH DATABASE ? AS work", (str(source),))
        tables = connection.execute(
            "SELECT name FROM main.sqlite_master WHERE type = 'table' "
            "AND name NOT LIKE 'sqlite%' AND name != 'descriptors' ORDER BY name"
        ).fetchall()
        for (table,) in tables:
            columns = connection.execute(f"PRAGMA main.table_info({table})").fetchall()
            keys = ", ".join(str(i + 1) for i in range(min(2, len(columns))))
            connection.execute(
                f"INSERT INTO main.{table} SELECT * FROM work.{table} ORDER BY {keys}"
            )
        connection.executemany(
            "UPDATE main.images SET name = ? WHERE image_id = ?",
            [(name, image_id) for image_id, name in names.items()],
        )
        connection.commit()
        connection.execute("DETACH DATABASE work")
        connection.execute("VACUUM")
    finally:
        connection.close()
