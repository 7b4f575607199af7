"""Matching and two-view verification of a scene's photographs.

Imports pycolmap and must not be imported in a process that uses torch (see ``isolate``).
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pipeline.config import schema
from pipeline.config.experiments import DEFAULT, MatchesExperiments
from pipeline.runtime.atomic import write_bytes
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest
from pipeline.sfm import pairs as choose
from pipeline.sfm.counters import MatchesCounters
from pipeline.sfm.database import (
    MatchingSettings,
    build_database,
    plan_cameras,
    verified_inliers,
)
from pipeline.sfm.fisheye import set_initial_focals
from pipeline.sfm.keypoints import Keypoints, keypoint_file
from pipeline.sfm.quiet import quiet_colmap

NAMES_SHOWN = 5


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


def match_features(
    manifest: Manifest,
    features: Path,
    config: schema.Matches,
    sharing: schema.Sfm,
    out: Path,
    *,
    seed: int,
    cache: Path | None = None,
    threads: int = 1,
    experiments: MatchesExperiments = DEFAULT.matches,
) -> MatchReport:
    """Choose pairs, match them and verify their two-view geometry.

    Writes ``out/database.db`` (COLMAP database: cameras with their priors, images with ids from 1
    in order of names, keypoints, matches, two-view geometries) and ``out/keypoint_colors.npz``
    (image id -> (F, 3) uint8). The files depend neither on ``threads`` nor on the cache.

    Args:
        features: folder written by ``extract_features``.
        config: options; ``pairs`` must not be "auto".
        sharing: options of the sfm stage, of which the camera model and sharing are used.
        cache: folder for results of pairs that outlives the call.

    Raises:
        UserError: no pair of photographs could be verified.
    """
    quiet_colmap()
    out.mkdir(parents=True, exist_ok=True)
    photos = sorted(manifest.photos, key=lambda photo: photo.name)
    names = [photo.name for photo in photos]
    cameras, camera_of = plan_cameras(manifest, sharing)
    images = [(index, name, camera_of[name]) for index, name in enumerate(names, start=1)]
    pairs, decision = resolve_pairs(manifest, features, config)
    initial = set_initial_focals(cameras, images, features, pairs, experiments.max_ratio, seed)
    settings = MatchingSettings(experiments.max_ratio, experiments.min_inliers, seed)
    database = out / "database.db"
    num_cached = build_database(
        database, cameras, images, features, pairs, settings, cache=cache, threads=threads
    )
    _write_colors(out / "keypoint_colors.npz", features, names)

    verified = verified_inliers(database)
    components, isolated = _components(names, list(verified))
    if not verified:
        raise UserError(
            f"no two of the {len(names)} photographs overlap: {len(pairs)} pairs were matched, and "
            f"none has a two-view geometry with {experiments.min_inliers} inliers",
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
            decision,
            *initial,
            f"{len(verified)} of {len(pairs)} pairs verified, with a median of {median} inliers",
            f"{len(cameras)} camera(s) ({_models(cameras)}) for {len(names)} photographs, "
            f"{priors} with a focal length from EXIF",
        ],
        warnings=warnings,
    )


def _models(cameras: list[pycolmap.Camera]) -> str:
    return ", ".join(sorted({camera.model_name for camera in cameras}))


def resolve_pairs(
    manifest: Manifest, features: Path, config: schema.Matches
) -> tuple[list[choose.Pair], str]:
    """The pairs to match, as indices into the photographs sorted by name, and a sentence about
    them for the log."""
    photos = sorted(manifest.photos, key=lambda photo: photo.name)
    count = len(photos)

    def descriptors() -> list[np.ndarray]:
        keep = choose.RETRIEVAL_DESCRIPTORS
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
    colors = {
        str(index): Keypoints.read(keypoint_file(features, name)).rgb
        for index, name in enumerate(names, start=1)
    }
    buffer = io.BytesIO()
    np.savez(buffer, **colors)  # type: ignore[arg-type]
    write_bytes(path, buffer.getvalue())
