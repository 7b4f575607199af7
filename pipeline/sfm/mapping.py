"""From verified matches to camera poses and sparse points.

Imports pycolmap: not to be imported beside torch (see ``isolate``).
"""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap

from pipeline.config import schema
from pipeline.runtime.errors import UserError
from pipeline.runtime.progress import Progress
from pipeline.scene.manifest import Manifest
from pipeline.sfm.database import share_cameras_by_size
from pipeline.sfm.evidence import gather
from pipeline.sfm.judge import Evidence, Verdict, judge
from pipeline.sfm.matching import shown
from pipeline.sfm.models import Colors, color_points, write_model
from pipeline.sfm.quiet import quiet_colmap
from pipeline.sfm.refine import refine

Mapper = Literal["incremental", "global"]

# A smaller model is no reconstruction; of two photographs, two must do.
MIN_MODEL_SIZE = 3

# Global mapping on the longest tracks alone: three times as fast, as accurate.
GLOBAL_TRACKS_PER_VIEW = 300

REMEDY = (
    "take more photographs around the subject, each sharing at least two thirds with the one "
    "before and from another place (do not only turn the camera); sharp, in unchanging light, of "
    "a textured, unmoving scene; or give known poses (sparse/0, transforms.json)"
)


@dataclass(frozen=True)
class CameraSummary:
    """One camera of the model: sizes and focal length in pixels, and where it came from."""

    camera_id: int
    model: str
    width: int
    height: int
    params: list[float]
    num_images: int
    focal_prior_px: float | None


@dataclass(frozen=True)
class SfmReport:
    """Attributes:
    mapper: the mapper whose model was taken.
    registered, total: photographs with a pose, and all.
    not_registered: names of the others.
    mean_reprojection_error_px, num_points, mean_track_length: of the model.
    other_models: numbers of images of the smaller models kept in ``other_models``.
    cameras: their summaries.
    verdict: "good" or "weak" (a failed one raises).
    evidence: what the verdict stands on (see ``judge.Evidence``).
    decisions, warnings: for people.
    """

    mapper: str
    registered: int
    total: int
    not_registered: list[str]
    mean_reprojection_error_px: float
    num_points: int
    mean_track_length: float
    other_models: list[int]
    cameras: list[CameraSummary]
    verdict: str
    evidence: dict[str, float | int | None]
    decisions: list[str]
    warnings: list[str]


@dataclass(frozen=True)
class _Attempt:
    mapper: Mapper
    models: list[pycolmap.Reconstruction]  # largest first
    evidence: Evidence | None
    verdict: Verdict
    database: Path


def reconstruct(
    manifest: Manifest, database: Path, config: schema.Sfm, out: Path, *, threads: int, seed: int
) -> SfmReport:
    """Write the largest model to ``out/sparse/0`` and the others to ``out/other_models/<n>``.

    The same bytes for any number of ``threads``: the libraries sum in the order their threads
    finish, so mapping runs on one (which on real scenes is no slower).

    Args:
        database: what ``match_features`` wrote (``keypoint_colors.npz`` beside it colours the
            points; it is not changed).
        config: ``mapper`` is settled, not "auto".

    Raises:
        UserError: no mapper found a model that can be believed.
    """
    quiet_colmap()
    if config.mapper == "auto":
        raise ValueError("the mapper is not settled")
    total = len(manifest.photos)
    with tempfile.TemporaryDirectory(prefix="splatmake-sfm-") as folder:
        # Opening a database can change its bytes: work on a copy.
        work = Path(folder) / "database.db"
        shutil.copyfile(database, work)
        warnings = _check_complete(manifest, work)
        attempt, decisions = _map_with_fallback(
            work, config.mapper, total, config.min_registered_share, seed
        )
        if attempt.verdict.grade == "failed" or attempt.evidence is None:
            raise UserError("no reconstruction: " + "; ".join(attempt.verdict.reasons), fix=REMEDY)
        model, evidence = attempt.models[0], attempt.evidence
        if attempt.verdict.grade == "good" or config.refine_principal_point == "yes":
            model, refined = refine(
                model,
                radial=config.refine_radial == "auto",
                principal_point=config.refine_principal_point,
            )
            decisions += refined
            # What the reader is told is of the model that is written.
            evidence = gather(model, attempt.database, total)
        else:
            decisions.append("cameras not refined further: weak geometry bends to what is freed")
    others = attempt.models[1:]
    folders = [out / "sparse" / "0"]
    folders += [out / "other_models" / str(index) for index in range(1, len(others) + 1)]
    colors = _read_colors(database.with_name("keypoint_colors.npz"))
    for each, folder_of in zip([model, *others], folders, strict=True):
        if colors is not None:
            color_points(each, colors)
        write_model(each, folder_of)

    registered = {model.image(i).name for i in model.reg_image_ids()}
    missing = [photo.name for photo in manifest.photos if photo.name not in registered]
    if missing:
        warnings.append(f"{len(missing)} of {total} photographs have no pose: {shown(missing)}")
    if others:
        sizes = ", ".join(str(other.num_reg_images()) for other in others)
        warnings.append(
            f"the photographs gave {len(attempt.models)} models that share no place: the largest "
            f"({len(registered)} photographs) is used; the others ({sizes}) are in other_models"
        )
    if attempt.verdict.grade == "weak":
        warnings.append("the reconstruction is weak: " + "; ".join(attempt.verdict.reasons))
    return SfmReport(
        mapper=attempt.mapper,
        registered=len(registered),
        total=total,
        not_registered=missing,
        mean_reprojection_error_px=float(model.compute_mean_reprojection_error()),
        num_points=int(model.num_points3D()),
        mean_track_length=float(model.compute_mean_track_length()),
        other_models=[int(other.num_reg_images()) for other in others],
        cameras=_camera_summaries(model, evidence),
        verdict=attempt.verdict.grade,
        evidence={k: v for k, v in asdict(evidence).items() if k != "focal_prior_px"},
        decisions=decisions,
        warnings=warnings,
    )


def _map_with_fallback(
    database: Path, first: Mapper, total: int, min_share: float, seed: int
) -> tuple[_Attempt, list[str]]:
    """The first mapper's attempt; where that is not good the best of it, of the other mapper's,
    and of the first one's with one camera for all photographs of a size (EXIF of pictures that
    were cropped or collected misleads), each tried only if nothing before was good."""
    other: Mapper = "global" if first == "incremental" else "incremental"
    shared = database.with_name("shared.db")
    best = _attempt(database, first, total, min_share, seed)
    decisions = [_told(best, total)]
    for mapper, path in ((other, database), (first, shared)):
        if best.verdict.grade == "good":
            break
        if path == shared and not share_cameras_by_size(database, shared):
            break
        attempt = _attempt(path, mapper, total, min_share, seed)
        note = " with one camera for each size" if path == shared else ""
        decisions.append(_told(attempt, total) + note)
        if _rank(attempt) > _rank(best):
            decisions.append(f"{mapper} mapping{note} is taken: it explains more")
            best = attempt
    return best, decisions


def _attempt(database: Path, mapper: Mapper, total: int, min_share: float, seed: int) -> _Attempt:
    with tempfile.TemporaryDirectory(dir=database.parent) as folder:
        run = _map_incremental if mapper == "incremental" else _map_global
        models = run(database, Path(folder), total, seed)
    smallest = min(MIN_MODEL_SIZE, total)
    models = [m for m in models if m.num_reg_images() >= smallest and m.num_points3D() > 0]
    # Ties go to the model with more points, then to the first found.
    models.sort(key=lambda m: (-m.num_reg_images(), -m.num_points3D()))
    evidence = gather(models[0], database, total) if models else None
    return _Attempt(mapper, models, evidence, judge(evidence, min_share), database)


def _rank(attempt: _Attempt) -> tuple[int, float]:
    if attempt.evidence is None:
        return -1, 0.0
    grade = ["failed", "weak", "good"].index(attempt.verdict.grade)
    return grade, attempt.evidence.registered * attempt.evidence.explained_matches


def _told(attempt: _Attempt, total: int) -> str:
    if not attempt.models:
        return f"{attempt.mapper} mapping: no model"
    model = attempt.models[0]
    return (
        f"{attempt.mapper} mapping: {model.num_reg_images()} of {total} photographs, "
        f"{model.num_points3D()} points, {attempt.verdict.grade}"
    )


def _map_incremental(
    database: Path, out: Path, total: int, seed: int
) -> list[pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1,
        random_seed=seed,
        min_model_size=min(MIN_MODEL_SIZE, total),
        extract_colors=False,
        # Fewer global adjustments: a third faster, as accurate.
        ba_local_max_refinements=1,
        ba_global_frames_ratio=1.5,
        ba_global_points_ratio=1.5,
    )
    # 1.8 times the points at the same accuracy, and points are what Gaussians start from.
    options.triangulation.ignore_two_view_tracks = False
    progress = Progress("mapping", total, "photographs")

    def registered() -> None:
        # Photographs tried again, or in a second model, count once more: stop at the total.
        if progress.done < progress.total:
            progress.advance()

    models = pycolmap.incremental_mapping(
        database, out, out, options, next_image_callback=registered
    )
    return [models[key] for key in sorted(models)]


def _map_global(database: Path, out: Path, total: int, seed: int) -> list[pycolmap.Reconstruction]:
    calibrated = out / "calibrated.db"
    shutil.copyfile(database, calibrated)
    # Global mapping trusts the focal lengths it is given: estimate those without a prior first.
    pycolmap.calibrate_view_graph(
        calibrated, pycolmap.ViewGraphCalibrationOptions(random_seed=seed)
    )
    options = pycolmap.GlobalPipelineOptions(
        num_threads=1, random_seed=seed, min_model_size=min(MIN_MODEL_SIZE, total)
    )
    options.mapper.num_threads = 1
    options.mapper.random_seed = seed
    options.mapper.track_required_tracks_per_view = GLOBAL_TRACKS_PER_VIEW
    options.mapper.retriangulation.ignore_two_view_tracks = False
    models = pycolmap.global_mapping(calibrated, out, out, options)
    return [models[key] for key in sorted(models)]


def _check_complete(manifest: Manifest, database: Path) -> list[str]:
    """Every photograph is in the database, or the folder and it do not belong together."""
    with pycolmap.Database.open(database) as opened:
        known = {image.name for image in opened.read_all_images()}
        empty = [
            image.name
            for image in opened.read_all_images()
            if opened.num_keypoints_for_image(image.image_id) == 0
        ]
    missing = [photo.name for photo in manifest.photos if photo.name not in known]
    if missing:
        raise UserError(
            f"{len(missing)} photographs are not in the database of matches: {shown(missing)}",
            file=database.name,
            fix="run the features and matches stages again",
        )
    return [f"no features in {shown(sorted(empty))}"] if empty else []


def _read_colors(path: Path) -> Colors | None:
    if not path.exists():
        return None
    with np.load(path) as data:
        return {int(key): data[key] for key in data.files}


def _camera_summaries(model: pycolmap.Reconstruction, evidence: Evidence) -> list[CameraSummary]:
    count: dict[int, int] = {}
    for image_id in model.reg_image_ids():
        camera_id = model.image(image_id).camera_id
        count[camera_id] = count.get(camera_id, 0) + 1
    return [
        CameraSummary(
            camera_id=camera_id,
            model=camera.model_name,
            width=camera.width,
            height=camera.height,
            params=[float(value) for value in camera.params],
            num_images=count[camera_id],
            focal_prior_px=evidence.focal_prior_px.get(camera_id),
        )
        for camera_id, camera in sorted(model.cameras.items())
        if camera_id in count
    ]
