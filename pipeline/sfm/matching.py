"""Matching and two-view verification of a scene's photographs.

Imports pycolmap and must not be imported in a process that uses torch (see ``isolate``).
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pipeline.config import settled
from pipeline.config.experiments import DEFAULT, MatchesExperiments
from pipeline.runtime.counters import Report
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest
from pipeline.sfm import pairs as choose
from pipeline.sfm.chunks import chunk
from pipeline.sfm.counters import MatchCounters, MatchesCounters
from pipeline.sfm.database import (
    MatchingInputs,
    build_database,
    match_pairs,
    plan_cameras,
    verified_inliers,
)
from pipeline.sfm.fisheye import set_initial_focals
from pipeline.sfm.keypoints import Keypoints, keypoint_file
from pipeline.sfm.models import is_uncalibrated, quiet_colmap, set_focal
from pipeline.sfm.pair_list import PairList
from pipeline.sfm.second_look import SecondLook, extract_more

#: The colours of the keypoints, beside the database: image id -> (F, 3) uint8.
COLORS_FILE = "keypoint_colors.npz"
NAMES_SHOWN = 5


@dataclass(frozen=True)
class MatchingScene:
    """The photographs that are matched, and how.

    Attributes:
        features: The folder that ``extract_features`` wrote.
        sharing: The options of the sfm stage, of which the camera model and sharing are used.
        seed: The seed of RANSAC.
    """

    manifest: Manifest
    features: Path
    sharing: settled.Sfm
    seed: int
    experiments: MatchesExperiments = DEFAULT.matches

    def inputs(self, focals: Mapping[int, float] | None = None) -> MatchingInputs:
        """The photographs in the order of their names, with ids from 1.

        Args:
            focals: The initial focal length in pixels by camera id, for fisheyes without a prior.
        """
        cameras, camera_of = plan_cameras(self.manifest, self.sharing)
        for camera in cameras:
            if focals and camera.camera_id in focals:
                set_focal(camera, focals[camera.camera_id])
        names = sorted(photo.name for photo in self.manifest.photos)
        images = [(id, name, camera_of[name]) for id, name in enumerate(names, start=1)]
        experiments = self.experiments
        return MatchingInputs(
            cameras,
            images,
            self.features,
            experiments.max_ratio,
            experiments.min_inliers,
            self.seed,
        )


def match_features(
    scene: MatchingScene,
    config: settled.Matches,
    database: Path,
    *,
    cache: Path | None = None,
    threads: int = 1,
    chosen: PairList | None = None,
    parts: Sequence[Path] = (),
    look: SecondLook | None = None,
) -> Report[MatchesCounters]:
    """Choose pairs, match them and verify their two-view geometry.

    Writes a COLMAP database: cameras with their priors, images with ids from 1 in order of names,
    keypoints, matches, two-view geometries; and beside it the keypoints' colours
    (``COLORS_FILE``). They depend neither on ``threads`` nor on the cache, nor on the number of
    jobs.

    Args:
        config: The settled options.
        database: The file that is written.
        cache: A folder for results of pairs that outlives the call.
        chosen: The result of ``choose_pairs``; None: the pairs are chosen.
        parts: The databases of the jobs that have matched them by ``match_chunk``, in order.
        look: The second look with more features; None: there is none.

    Raises:
        UserError: No pair of photographs could be verified.
    """
    quiet_colmap()
    chosen = chosen or choose_pairs(scene, config)
    pairs, inputs = chosen.pairs, scene.inputs(chosen.focals)
    matched = [(part, chunk(pairs, i, len(parts))) for i, part in enumerate(parts, start=1)]
    num_cached = build_database(
        database, inputs, pairs, cache=cache, matched=matched, threads=threads
    )
    names, cameras = [name for _, name, _ in inputs.images], inputs.cameras
    verified = verified_inliers(database)
    decisions = list(chosen.decisions)
    if look is not None and look.is_needed(names, verified):
        extract_more(scene.manifest, look, threads)
        scene = replace(scene, features=look.out)
        build_database(database, scene.inputs(chosen.focals), pairs, cache=cache, threads=threads)
        before, verified = len(verified), verified_inliers(database)
        decisions.append(look.decision(before, len(verified)))
    _write_colors(scene.inputs(), database.with_name(COLORS_FILE))
    if not verified:
        raise UserError(
            f"no two of the {len(names)} photographs overlap: {len(pairs)} pairs were matched, and "
            f"none has a two-view geometry with {inputs.min_inliers} inliers",
            fix="photograph a static, textured scene from all sides in constant light, each "
            "photograph overlapping the previous one by two thirds",
        )
    components, isolated = _components(names, list(verified))
    warnings = []
    if len(components) > 1:
        warnings.append(
            f"verified pairs connect the photographs into {len(components)} separate groups: the "
            f"largest has {components[0]} of {len(names)}; outside it: {list_names(isolated)}"
        )
    priors = sum(camera.has_prior_focal_length and not camera.is_spherical() for camera in cameras)
    models = ", ".join(sorted({camera.model_name for camera in cameras}))
    counters = MatchesCounters(
        num_pairs=len(pairs),
        num_verified=len(verified),
        median_inliers=int(np.median(list(verified.values()))),
        components=components,
        isolated=isolated,
        num_cameras=len(cameras),
    )
    decisions += [
        f"{len(verified)} of {len(pairs)} pairs verified, with a median of "
        f"{counters.median_inliers} inliers",
        f"{len(cameras)} camera(s) ({models}) for {len(names)} photographs, {priors} with a focal "
        "length from EXIF",
    ]
    return Report(counters, decisions, warnings, num_cached)


def choose_pairs(scene: MatchingScene, config: settled.Matches) -> PairList:
    """Choose the pairs to match, and initial focal lengths by the first of them where cameras need
    one."""
    quiet_colmap()
    pairs, decision = resolve_pairs(scene.manifest, scene.features, config)
    inputs = scene.inputs()
    initial = set_initial_focals(inputs, pairs)
    fisheyes = filter(is_uncalibrated, inputs.cameras)
    return PairList(
        pairs=pairs,
        focals={camera.camera_id: float(camera.mean_focal_length()) for camera in fisheyes},
        decisions=[decision, *initial],
    )


def match_chunk(
    scene: MatchingScene,
    chosen: PairList,
    pairs: Sequence[choose.Pair],
    database: Path,
    *,
    cache: Path,
    scratch: Path,
    threads: int = 1,
) -> Report[MatchCounters]:
    """Match and verify the pairs of one of several jobs. ``match_features`` gathers them.

    Args:
        chosen: The pairs of all jobs.
        pairs: The pairs of this job (``chunk``).
        database: The file that is written, a COLMAP database with the results of the pairs.
        cache: The folder that ``match_features`` uses; it is only read.
        scratch: A folder that a later call with the same arguments finds if this one is killed.
    """
    quiet_colmap()
    inputs = scene.inputs(chosen.focals)
    num_cached, num_verified = match_pairs(
        database, inputs, pairs, cache=cache, scratch=scratch, threads=threads
    )
    counters = MatchCounters(num_pairs=len(pairs), num_verified=num_verified)
    decisions = [f"{num_verified} of {len(pairs)} pairs verified"]
    return Report(counters, decisions, num_cached=num_cached)


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


def _write_colors(inputs: MatchingInputs, path: Path) -> None:
    """Write image id -> (F, 3) uint8 colours of its keypoints, as by ``np.savez``, with the colours
    of one image in memory at a time."""
    with zipfile.ZipFile(path, "w") as archive:
        for image_id, colors in inputs.colors():
            # A member written by its name gets a fixed date.
            with archive.open(f"{image_id}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, colors)


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
