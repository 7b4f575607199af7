"""Mapping again, another way, where the first model is not good; at most so many times.

Each attempt starts from the same verified matches. What is changed is the mapper, or what is
believed of the cameras before any geometry is seen. More features and more pairs are other stages'
work: the message of a failure names their options.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from pipeline.sfm.database import DEFAULT_FOCAL_FACTOR, share_cameras_by_size
from pipeline.sfm.evidence import gather
from pipeline.sfm.judge import Evidence, Grade, Verdict, judge
from pipeline.sfm.mappers import Mapper, run_mapper

# Focal lengths over the longer side that are tried where none is known: wide, normal, long lens.
SWEPT_FOCALS = (0.55, DEFAULT_FOCAL_FACTOR, 2.5)
# Those nearer to one another than this lead to the same place.
SAME_FOCAL = 1.4
FISHEYE_FOCAL = 0.4
# Wider lenses than this (focal length over the longer side) may be fisheyes.
FISHEYE_BELOW = 0.6


@dataclass(frozen=True)
class AttemptRecord:
    """One attempt, for the stage's record.

    Attributes:
        change: what was done otherwise than in the first, "" for the first.
        registered: photographs of the largest model, 0 without one.
    """

    mapper: Mapper
    change: str
    registered: int
    verdict: Grade
    reasons: list[str]
    taken: bool


@dataclass(frozen=True)
class Attempt:
    """Attributes:
    models: largest first.
    database: what they were made from.
    """

    mapper: Mapper
    change: str
    models: list[pycolmap.Reconstruction]
    evidence: Evidence | None
    verdict: Verdict
    database: Path

    def record(self, taken: bool) -> AttemptRecord:
        return AttemptRecord(
            self.mapper,
            self.change,
            int(self.models[0].num_reg_images()) if self.models else 0,
            self.verdict.grade,
            self.verdict.reasons,
            taken,
        )


def map_until_good(
    database: Path, first: Mapper, total: int, min_share: float, seed: int, budget: int
) -> tuple[Attempt, list[AttemptRecord]]:
    """The best of at most ``budget`` attempts, of which the first that is good is the last; and the
    record of all. The database is not changed; others are made beside it."""
    best = _attempt(database, first, "", total, min_share, seed)
    attempts = [best]
    for mapper, change, prepare in _alternatives(database, first):
        if best.verdict.grade == "good" or not best.verdict.curable or len(attempts) >= budget:
            break
        path = database
        if prepare is not None:
            path = database.with_name(f"attempt_{len(attempts)}.db")
            if not prepare(path):
                continue
        attempt = _attempt(path, mapper, change, total, min_share, seed)
        attempts.append(attempt)
        if _rank(attempt) > _rank(best):
            best = attempt
    return best, [attempt.record(attempt is best) for attempt in attempts]


def _alternatives(
    database: Path, first: Mapper
) -> Iterator[tuple[Mapper, str, Callable[[Path], bool] | None]]:
    """Mapper, what is changed, and what makes the changed database (False where it would be no
    change), the most promising first."""
    other: Mapper = "global" if first == "incremental" else "incremental"
    yield other, "", None

    def one_camera(path: Path) -> bool:
        return share_cameras_by_size(database, path)

    yield first, "one camera for all photographs of a size, EXIF ignored", one_camera

    def fisheye(path: Path) -> bool:
        return _set_cameras(database, path, "OPENCV_FISHEYE", FISHEYE_FOCAL)

    tried = _believed_focals(database)
    seen = _view_graph_focal(database)
    wide = min(seen, *tried) < FISHEYE_BELOW
    if wide:
        yield first, "fisheye cameras", fisheye
    for focal in (seen, *SWEPT_FOCALS):
        if any(max(focal / t, t / focal) < SAME_FOCAL for t in tried):
            continue
        tried.append(focal)

        def believed(path: Path, focal: float = focal) -> bool:
            return _set_cameras(database, path, None, focal)

        yield first, f"EXIF ignored, a focal length of {focal:.2f} times the longer side", believed
    if not wide:
        yield first, "fisheye cameras", fisheye


def _attempt(
    database: Path, mapper: Mapper, change: str, total: int, min_share: float, seed: int
) -> Attempt:
    models = run_mapper(mapper, database, total, seed)
    evidence = gather(models[0], database, total) if models else None
    return Attempt(mapper, change, models, evidence, judge(evidence, min_share), database)


def _rank(attempt: Attempt) -> tuple[int, float]:
    e = attempt.evidence
    if e is None:
        return -1, 0.0
    grade = ("failed", "weak", "good").index(attempt.verdict.grade)
    return grade, e.registered * e.explained_matches * e.agreeing_pairs


def _believed_focals(database: Path) -> list[float]:
    """Focal lengths over the longer side that the first attempt started from: the extremes."""
    with pycolmap.Database.open(database) as opened:
        cameras = opened.read_all_cameras()
    found = [c.mean_focal_length() / max(c.width, c.height) for c in cameras]
    return [float(min(found)), float(max(found))]


def _view_graph_focal(database: Path) -> float:
    """What the pairs' fundamental matrices say of the focal length, over the longer side: the
    median camera's. Right within a factor of two where the photographs tell it."""
    with tempfile.TemporaryDirectory(dir=database.parent) as folder:
        copy = Path(folder) / "calibrated.db"
        _set_cameras(database, copy, None, DEFAULT_FOCAL_FACTOR)
        pycolmap.calibrate_view_graph(
            copy,
            pycolmap.ViewGraphCalibrationOptions(random_seed=0, reestimate_relative_pose=False),
        )
        return _believed_median(copy)


def _believed_median(database: Path) -> float:
    with pycolmap.Database.open(database) as opened:
        cameras = opened.read_all_cameras()
    found = sorted(c.mean_focal_length() / max(c.width, c.height) for c in cameras)
    return float(found[len(found) // 2])


def _set_cameras(source: Path, target: Path, model: str | None, focal: float) -> bool:
    """Copy a database, its cameras without a prior, of this model (None: as they are) and focal
    length (over the longer side)."""
    shutil.copyfile(source, target)
    with pycolmap.Database.open(target) as database:
        for camera in database.read_all_cameras():
            side = max(camera.width, camera.height)
            database.update_camera(
                pycolmap.Camera.create_from_model_name(
                    camera.camera_id,
                    model or camera.model_name,
                    focal * side,
                    camera.width,
                    camera.height,
                )
            )
    return True
