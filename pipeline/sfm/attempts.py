"""Mapping attempts: if the first model is not good, map again with another mapper or other cameras.

Attempts differ in the mapper, in the initial camera parameters, or in the verified pairs that they
use: pairs of parts that look alike are left out. More features or more pairs need other stages: the
message of a failure names the options.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path

import pycolmap

from pipeline.sfm.continuity import Names
from pipeline.sfm.counters import AttemptRecord, Mapper
from pipeline.sfm.database import share_cameras_by_size
from pipeline.sfm.evidence import collect_evidence
from pipeline.sfm.judge import (
    MAX_MISSING_COVISIBILITY,
    MIN_AGREEING_PAIRS,
    Evidence,
    Verdict,
    judge,
)
from pipeline.sfm.look_alikes import leave_out_look_alikes
from pipeline.sfm.mappers import run_mapper
from pipeline.sfm.models import DEFAULT_FOCAL_FACTOR, uncalibrated

# Initial focal lengths over the longer side that are tried: wide, normal and long lens.
SWEPT_FOCALS = (0.55, DEFAULT_FOCAL_FACTOR, 2.5)
# Initial focal lengths within this ratio converge to the same result.
SAME_FOCAL_RATIO = 1.4
FISHEYE_FOCAL = 0.4
# A lens with a focal length over the longer side below this may be a fisheye.
FISHEYE_BELOW = 0.6

LOOK_ALIKES_LEFT_OUT = "pairs left out that contradict the most distinctive ones"

# Maximum number of reconstructions of a scene.
MAX_ATTEMPTS = 4


@dataclass(frozen=True)
class Attempt:
    """One mapping attempt and its models.

    Attributes:
        change: The difference from the first attempt in words; empty for the first.
        models: The models found, largest first.
        evidence, verdict: The quality of the largest model.
        database: The database that was mapped.
        spare: The models of other attempts with photographs that no model of this one has.
    """

    mapper: Mapper
    change: str
    models: list[pycolmap.Reconstruction]
    evidence: Evidence | None
    verdict: Verdict
    database: Path
    spare: Sequence[pycolmap.Reconstruction] = ()

    def record(self, taken: bool) -> AttemptRecord:
        """The attempt for ``stage.json``; ``taken``: whether its model is used."""
        return AttemptRecord(
            mapper=self.mapper,
            change=self.change,
            registered=int(self.models[0].num_reg_images()) if self.models else 0,
            verdict=self.verdict.grade,
            reasons=self.verdict.reasons,
            taken=taken,
        )


def map_until_good(
    database: Path,
    first: Mapper,
    total: int,
    min_share: float,
    seed: int,
    budget: int = MAX_ATTEMPTS,
    steps: Sequence[Names] = (),
) -> tuple[Attempt, list[AttemptRecord]]:
    """Map a scene until a model is good.

    Args:
        database: The database of verified matches. It is not changed; changed copies are written
            beside it.
        first: The mapper of the first attempt.
        total: The number of photographs of the scene.
        min_share: The share of registered images below which a model has failed.
        budget: The maximum number of attempts.
        steps: The result of ``sequence_steps``.

    Returns:
        The best attempt and the records of all attempts, in order.
    """

    def attempt_with(path: Path, mapper: Mapper, change: str) -> Attempt:
        models = run_mapper(mapper, path, total, seed)
        evidence = collect_evidence(models[0], path, total, steps, database) if models else None
        return Attempt(mapper, change, models, evidence, judge(evidence, min_share), path)

    def leave_out(target: Path) -> bool:
        return leave_out_look_alikes(database, frozenset(steps), total, seed, target)

    best = attempt_with(database, first, "")
    attempts = [best]
    for mapper, change, prepare in chain(
        _without_look_alikes(best, leave_out), _alternatives(database, first)
    ):
        is_final = best.verdict.grade == "good" or not best.verdict.worth_retrying
        if is_final or len(attempts) >= budget:
            break
        path = database
        if prepare is not None:
            path = database.with_name(f"attempt_{len(attempts)}.db")
            if not prepare(path):
                continue
        attempt = attempt_with(path, mapper, change)
        attempts.append(attempt)
        if _rank(attempt) > _rank(best):
            best = attempt
        if change == LOOK_ALIKES_LEFT_OUT and attempt.verdict.grade != "failed":
            # The others use the pairs that contradict this model.
            break
    records = [attempt.record(attempt is best) for attempt in attempts]
    return replace(best, spare=_spare(best, attempts)), records


def _spare(best: Attempt, attempts: Sequence[Attempt]) -> list[pycolmap.Reconstruction]:
    if best.change == LOOK_ALIKES_LEFT_OUT:
        # The others may be folded, and no pair is left that would contradict them.
        return []
    registered = {image_id for model in best.models for image_id in model.reg_image_ids()}
    return [
        model
        for attempt in attempts
        for model in attempt.models
        if not set(model.reg_image_ids()) <= registered
    ]


def _alternatives(
    database: Path, first: Mapper
) -> Iterator[tuple[Mapper, str, Callable[[Path], bool] | None]]:
    """Alternatives to the first attempt, the most promising first.

    Yields:
        The mapper, the difference in words, and a function that writes a changed database to a
        path and returns False if nothing would change (None: the same database).
    """
    other: Mapper = "global" if first == "incremental" else "incremental"
    yield other, "", None
    if not (initial := _initial_focals(database)):
        return
    yield (
        first,
        "one camera for all photographs of a size, EXIF ignored",
        partial(share_cameras_by_size, database),
    )
    fisheye = partial(_set_cameras, database, focal=FISHEYE_FOCAL, model="OPENCV_FISHEYE")
    tried = [initial[0], initial[-1]]
    estimated = _view_graph_focal(database)
    wide = min(estimated, *tried) < FISHEYE_BELOW
    if wide:
        yield first, "fisheye cameras", fisheye
    for focal in (estimated, *SWEPT_FOCALS):
        if any(max(focal / t, t / focal) < SAME_FOCAL_RATIO for t in tried):
            continue
        tried.append(focal)
        change = f"EXIF ignored, initial focal length {focal:.2f} times the longer side"
        yield first, change, partial(_set_cameras, database, focal=focal)
    if not wide:
        yield first, "fisheye cameras", fisheye


def _without_look_alikes(
    first: Attempt, leave_out: Callable[[Path], bool]
) -> Iterator[tuple[Mapper, str, Callable[[Path], bool] | None]]:
    """As ``_alternatives``, if the first model may be folded."""
    e = first.evidence
    if e is not None and (
        e.broken_steps
        or min(e.agreeing_pairs, e.agreeing_distinctive) < MIN_AGREEING_PAIRS[1]
        or e.missing_covisibility > MAX_MISSING_COVISIBILITY[1]
    ):
        yield first.mapper, LOOK_ALIKES_LEFT_OUT, leave_out


def _rank(attempt: Attempt) -> tuple[int, float]:
    """Sort key of attempts: larger is better."""
    e = attempt.evidence
    if e is None:
        return -1, 0.0
    grade = ("failed", "weak", "good").index(attempt.verdict.grade)
    return grade, e.registered * e.explained_matches * e.agreeing_pairs


def _initial_focals(database: Path) -> list[float]:
    """The initial focal lengths over the longer side of all cameras but those of panoramas, which
    have none; ascending."""
    with pycolmap.Database.open(database) as opened:
        cameras = [camera for camera in opened.read_all_cameras() if not camera.is_spherical()]
    return sorted(float(c.mean_focal_length() / max(c.width, c.height)) for c in cameras)


def _view_graph_focal(database: Path) -> float:
    """Median focal length over the longer side, estimated from the pairs' fundamental matrices
    (view graph calibration). Accurate within a factor of two if the images determine it."""
    with tempfile.TemporaryDirectory(dir=database.parent) as folder:
        copy = Path(folder) / "calibrated.db"
        _set_cameras(database, copy, DEFAULT_FOCAL_FACTOR)
        pycolmap.calibrate_view_graph(
            copy,
            pycolmap.ViewGraphCalibrationOptions(random_seed=0, reestimate_relative_pose=False),
        )
        found = _initial_focals(copy)
        return found[len(found) // 2]


def _set_cameras(source: Path, target: Path, focal: float, model: str | None = None) -> bool:
    """Copy a database; its cameras, except of panoramas, get this model (None: unchanged) and focal
    length (over the longer side), without a prior."""
    shutil.copyfile(source, target)
    with pycolmap.Database.open(target) as database:
        for camera in database.read_all_cameras():
            if not camera.is_spherical():
                database.update_camera(uncalibrated(camera, focal, model))
    return True
