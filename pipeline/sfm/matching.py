"""Matching and two-view verification of a scene's photographs.

Imports pycolmap and must not be imported in a process that uses torch (see ``isolate``).
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pipeline.config import settled
from pipeline.config.experiments import DEFAULT, MatchesExperiments
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest
from pipeline.sfm import pairs as choose
from pipeline.sfm.chunks import chunk
from pipeline.sfm.counters import MatchCounters, MatchesCounters
from pipeline.sfm.database import (
    MatchingSettings,
    build_database,
    match_pairs,
    plan_cameras,
    verified_inliers,
)
from pipeline.sfm.fisheye import is_uncalibrated, set_focal, set_initial_focals
from pipeline.sfm.keypoints import Keypoints, keypoint_file
from pipeline.sfm.pair_list import PairList
from pipeline.sfm.quiet import quiet_colmap

NAMES_SHOWN = 5
# A COLMAP database with the results of the pairs of one of several jobs.
CHUNK_FILE = "pairs.db"


@dataclass(frozen=True)
class MatchingScene:
    """The photographs that are matched, and how.

    Attributes:
        features: folder written by ``extract_features``.
        sharing: options of the sfm stage, of which the camera model and sharing are used.
        seed: of RANSAC.
    """

    manifest: Manifest
    features: Path
    sharing: settled.Sfm
    seed: int
    experiments: MatchesExperiments = DEFAULT.matches

    def cameras_and_images(self) -> tuple[list[pycolmap.Camera], list[tuple[int, str, int]]]:
        """The cameras, and (image id, name, camera id) in the order of names."""
        cameras, camera_of = plan_cameras(self.manifest, self.sharing)
        names = sorted(photo.name for photo in self.manifest.photos)
        return cameras, [(id, name, camera_of[name]) for id, name in enumerate(names, start=1)]

    @property
    def settings(self) -> MatchingSettings:
        experiments = self.experiments
        return MatchingSettings(experiments.max_ratio, experiments.min_inliers, self.seed)


@dataclass(frozen=True)
class MatchReport:
    """Result of the matches stage.

    Attributes:
        num_cached: number of pairs found in the cache.
        decisions, warnings: sentences for the log.
    """

    counters: MatchesCounters
    num_cached: int
    decisions: list[str]
    warnings: list[str]


@dataclass(frozen=True)
class ChunkReport:
    """Result of a job that matches some of the pairs; attributes as of ``MatchReport``."""

    counters: MatchCounters
    num_cached: int
    decisions: list[str]


def match_features(
    scene: MatchingScene,
    config: settled.Matches,
    out: Path,
    *,
    cache: Path | None = None,
    threads: int = 1,
    chosen: PairList | None = None,
    parts: Sequence[Path] = (),
) -> MatchReport:
    """Choose pairs, match them and verify their two-view geometry.

    Writes ``out/database.db`` (COLMAP database: cameras with their priors, images with ids from 1
    in order of names, keypoints, matches, two-view geometries) and ``out/keypoint_colors.npz``
    (image id -> (F, 3) uint8). The files depend neither on ``threads`` nor on the cache, nor on the
    number of jobs.

    Args:
        config: The settled options.
        cache: folder for results of pairs that outlives the call.
        chosen: result of ``choose_pairs``; None: the pairs are chosen.
        parts: folders of the jobs that have matched them by ``match_chunk``, in order.

    Raises:
        UserError: no pair of photographs could be verified.
    """
    quiet_colmap()
    out.mkdir(parents=True, exist_ok=True)
    if chosen is None:
        chosen = choose_pairs(scene, config)
    pairs = chosen.pairs
    cameras, images = scene.cameras_and_images()
    _set_focals(cameras, chosen.focals)
    names = [name for _, name, _ in images]
    database = out / "database.db"
    num_cached = build_database(
        database,
        cameras,
        images,
        scene.features,
        pairs,
        scene.settings,
        cache=cache,
        matched=[
            (part / CHUNK_FILE, chunk(pairs, number, len(parts)))
            for number, part in enumerate(parts, start=1)
        ],
        threads=threads,
    )
    _write_colors(out / "keypoint_colors.npz", scene.features, names)

    verified = verified_inliers(database)
    components, isolated = _components(names, list(verified))
    if not verified:
        raise UserError(
            f"no two of the {len(names)} photographs overlap: {len(pairs)} pairs were matched, and "
            f"none has a two-view geometry with {scene.settings.min_inliers} inliers",
            fix="photograph a static, textured scene from all sides in constant light, each "
            "photograph overlapping the previous one by two thirds",
        )
    warnings = []
    if len(components) > 1:
        warnings.append(
            f"verified pairs connect the photographs into {len(components)} separate groups: the "
            f"largest has {components[0]} of {len(names)}; outside it: {list_names(isolated)}"
        )
    priors = sum(camera.has_prior_focal_length and not camera.is_spherical() for camera in cameras)
    median = int(np.median(list(verified.values())))
    counters = MatchesCounters(
        num_pairs=len(pairs),
        num_verified=len(verified),
        median_inliers=median,
        components=components,
        isolated=isolated,
        num_cameras=len(cameras),
    )
    return MatchReport(
        counters=counters,
        num_cached=num_cached,
        decisions=[
            *chosen.decisions,
            f"{len(verified)} of {len(pairs)} pairs verified, with a median of {median} inliers",
            f"{len(cameras)} camera(s) ({_models(cameras)}) for {len(names)} photographs, "
            f"{priors} with a focal length from EXIF",
        ],
        warnings=warnings,
    )


def choose_pairs(scene: MatchingScene, config: settled.Matches) -> PairList:
    """Choose the pairs to match, and initial focal lengths by the first of them where cameras need
    one."""
    quiet_colmap()
    pairs, decision = resolve_pairs(scene.manifest, scene.features, config)
    cameras, images = scene.cameras_and_images()
    uncalibrated = [camera for camera in cameras if is_uncalibrated(camera)]
    initial = set_initial_focals(
        uncalibrated, images, scene.features, pairs, scene.experiments.max_ratio, scene.seed
    )
    return PairList(
        pairs=pairs,
        focals={camera.camera_id: float(camera.mean_focal_length()) for camera in uncalibrated},
        decisions=[decision, *initial],
    )


def match_chunk(
    scene: MatchingScene,
    chosen: PairList,
    number: int,
    jobs: int,
    out: Path,
    *,
    cache: Path,
    scratch: Path,
    threads: int = 1,
) -> ChunkReport:
    """Match and verify the pairs of one of several jobs. ``match_features`` gathers them.

    Args:
        number: of the job, from 1.
        jobs: the number of all jobs.
        cache: as of ``match_features``; it is only read.
        scratch: folder that a later call with the same arguments finds if this one is killed.
    """
    quiet_colmap()
    cameras, images = scene.cameras_and_images()
    _set_focals(cameras, chosen.focals)
    pairs = chunk(chosen.pairs, number, jobs)
    num_cached, num_verified = match_pairs(
        out / CHUNK_FILE,
        cameras,
        images,
        scene.features,
        pairs,
        scene.settings,
        cache=cache,
        scratch=scratch,
        threads=threads,
    )
    return ChunkReport(
        MatchCounters(num_pairs=len(pairs), num_verified=num_verified),
        num_cached,
        [f"{num_verified} of {len(pairs)} pairs verified"],
    )


def _set_focals(cameras: Sequence[pycolmap.Camera], focals: Mapping[int, float]) -> None:
    for camera in cameras:
        if camera.camera_id in focals:
            set_focal(camera, focals[camera.camera_id])


def _models(cameras: list[pycolmap.Camera]) -> str:
    return ", ".join(sorted({camera.model_name for camera in cameras}))


def resolve_pairs(
    manifest: Manifest, features: Path, config: settled.Matches
) -> tuple[list[choose.Pair], str]:
    """The pairs to match, as indices into the photographs sorted by name, and a sentence about
    them for the log."""
    photos = sorted(manifest.photos, key=lambda photo: photo.name)
    count = len(photos)

    def descriptors() -> list[np.ndarray]:
        keep = choose.descriptors_per_photo(count)
        files = [keypoint_file(features, photo.name) for photo in photos]
        return [Keypoints.read(file).descriptors[:keep].copy() for file in files]

    if config.pairs == "exhaustive":
        pairs = choose.exhaustive_pairs(count)
    elif config.pairs == "sequential":
        near = choose.sequential_pairs(count, config.neighbours)
        loops = choose.loop_closure_pairs(descriptors(), config.neighbours)
        pairs = sorted({*near, *loops})
    elif config.pairs == "spatial":
        near = choose.spatial_pairs([photo.gps for photo in photos], config.neighbours)
        without_gps = {i for i, photo in enumerate(photos) if photo.gps is None}
        if without_gps:
            similar = choose.retrieval_pairs(descriptors(), config.neighbours)
            near += [pair for pair in similar if without_gps & set(pair)]
        pairs = sorted(set(near))
    elif config.pairs == "retrieval":
        pairs = choose.retrieval_pairs(descriptors(), config.neighbours)
    else:
        raise ValueError(f"the kind of pairs must be chosen, found: {config.pairs}")
    return pairs, f"{config.pairs} pairs: {len(pairs)} of {count * (count - 1) // 2} possible"


def list_names(names: list[str]) -> str:
    """The first few names, and the number of the others."""
    rest = len(names) - NAMES_SHOWN
    text = ", ".join(names[:NAMES_SHOWN])
    return f"{text} and {rest} more" if rest > 0 else text


def _components(names: list[str], verified: list[tuple[str, str]]) -> tuple[list[int], list[str]]:
    """Sizes of the connected components, largest first, and the names outside the largest."""
    index = {name: i for i, name in enumerate(names)}
    rows, columns = [index[a] for a, _ in verified], [index[b] for _, b in verified]
    shape = (len(names), len(names))
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=shape)
    _, label = connected_components(graph, directed=False)
    sizes = np.bincount(label)
    largest = int(sizes.argmax())
    outside = [name for name, own in zip(names, label, strict=True) if own != largest]
    return sorted((int(size) for size in sizes), reverse=True), outside


def _write_colors(path: Path, features: Path, names: list[str]) -> None:
    """As by ``np.savez``, with the colours of one image in memory at a time."""
    with zipfile.ZipFile(path, "w") as archive:
        for index, name in enumerate(names, start=1):
            colors = Keypoints.read(keypoint_file(features, name)).rgb
            # By its name, a member gets a fixed date.
            with archive.open(f"{index}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, colors)
