"""Matching and two-view verification of a scene's photographs.

Imports pycolmap: not to be imported beside torch (see ``isolate``).
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pipeline.config import schema
from pipeline.config.experiments import DEFAULT, MatchesExperiments
from pipeline.runtime.atomic import write_bytes
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest
from pipeline.sfm import pairs as choose
from pipeline.sfm.database import (
    MatchingSettings,
    build_database,
    plan_cameras,
    verified_inliers,
)
from pipeline.sfm.keypoints import Keypoints, keypoint_file
from pipeline.sfm.quiet import quiet_colmap

NAMES_SHOWN = 5


@dataclass(frozen=True)
class MatchReport:
    """Attributes:
    num_pairs, num_verified: pairs matched, and those that a two-view geometry explains.
    median_inliers: verified matches of the median verified pair.
    components: sizes of the sets of photographs that verified pairs hold together, largest first.
    isolated: names of the photographs outside the largest set.
    num_cameras: cameras shared out among the photographs.
    num_cached: pairs whose result was found in the cache.
    decisions, warnings: for people.
    """

    num_pairs: int
    num_verified: int
    median_inliers: int
    components: list[int]
    isolated: list[str]
    num_cameras: int
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
    """Write ``out/database.db`` (COLMAP's: cameras with their priors, images with ids from 1 in
    order of names, keypoints, matches, verified geometries) and ``out/keypoint_colors.npz``
    (image id -> (F, 3) uint8). The bits depend neither on ``threads`` nor on the cache.

    Args:
        features: the folder ``extract_features`` wrote.
        config: ``pairs`` is settled, not "auto".
        sharing: its camera model and sharing.
        cache: folder for pairs' results that outlives the call.

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
    settings = MatchingSettings(experiments.max_ratio, config.min_inliers, seed)
    database = out / "database.db"
    num_cached = build_database(
        database, cameras, images, features, pairs, settings, cache=cache, threads=threads
    )
    _write_colors(out / "keypoint_colors.npz", features, names)

    verified = verified_inliers(database)
    components, isolated = _components(names, list(verified))
    if not verified:
        raise UserError(
            f"no two of the {len(names)} photographs show the same thing: {len(pairs)} pairs were "
            f"matched, and in none did {config.min_inliers} matches agree on how the camera moved",
            fix="photograph one textured, unmoving thing from all sides, in light that stays, each "
            "picture sharing at least two thirds with the one before",
        )
    warnings = []
    if len(components) > 1:
        warnings.append(
            f"the photographs fall into {len(components)} sets that no verified pair links: the "
            f"largest has {components[0]} of {len(names)}; outside it: {shown(isolated)}"
        )
    priors = sum(camera.has_prior_focal_length for camera in cameras)
    median = int(np.median(list(verified.values())))
    return MatchReport(
        num_pairs=len(pairs),
        num_verified=len(verified),
        median_inliers=median,
        components=components,
        isolated=isolated,
        num_cameras=len(cameras),
        num_cached=num_cached,
        decisions=[
            decision,
            f"{len(verified)} of {len(pairs)} pairs verified, {median} matches in the median one",
            f"{len(cameras)} camera(s) ({cameras[0].model_name}) for {len(names)} photographs, "
            f"{priors} with a focal length from EXIF",
        ],
        warnings=warnings,
    )


def resolve_pairs(
    manifest: Manifest, features: Path, config: schema.Matches
) -> tuple[list[choose.Pair], str]:
    """The pairs to match, as indices into the photographs sorted by name, and why these."""
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
        unplaced = {i for i, photo in enumerate(photos) if photo.gps is None}
        if unplaced:
            alike = choose.retrieval_pairs(descriptors(), config.neighbours)
            near += [pair for pair in alike if unplaced & set(pair)]
        pairs = sorted(set(near))
    elif config.pairs == "retrieval":
        pairs = choose.retrieval_pairs(descriptors(), config.neighbours)
    else:
        raise ValueError(f"pairs are not settled: {config.pairs}")
    return pairs, f"{config.pairs} pairs: {len(pairs)} of {count * (count - 1) // 2} possible"


def shown(names: list[str]) -> str:
    """The first few names, and how many more there are."""
    rest = len(names) - NAMES_SHOWN
    text = ", ".join(names[:NAMES_SHOWN])
    return f"{text} and {rest} more" if rest > 0 else text


def _components(names: list[str], verified: list[tuple[str, str]]) -> tuple[list[int], list[str]]:
    """Sizes of the connected sets, largest first, and the names outside the first of them."""
    place = {name: i for i, name in enumerate(names)}
    rows, columns = [place[a] for a, _ in verified], [place[b] for _, b in verified]
    shape = (len(names), len(names))
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=shape)
    _, label = connected_components(graph, directed=False)
    sizes = np.bincount(label)
    largest = int(sizes.argmax())
    outside = [name for name, at in zip(names, label, strict=True) if at != largest]
    return sorted((int(size) for size in sizes), reverse=True), outside


def _write_colors(path: Path, features: Path, names: list[str]) -> None:
    colors = {
        str(index): Keypoints.read(keypoint_file(features, name)).rgb
        for index, name in enumerate(names, start=1)
    }
    buffer = io.BytesIO()
    np.savez(buffer, **colors)  # type: ignore[arg-type]
    write_bytes(path, buffer.getvalue())
