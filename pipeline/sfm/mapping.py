"""From verified matches to camera poses and sparse points.

Imports pycolmap: not to be imported beside torch (see ``isolate``).
"""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from pipeline.config import schema
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest
from pipeline.sfm.escalation import Attempt, AttemptRecord, map_until_good
from pipeline.sfm.evidence import gather
from pipeline.sfm.georeference import summary
from pipeline.sfm.judge import Evidence
from pipeline.sfm.matching import shown
from pipeline.sfm.models import Colors, color_points, write_model
from pipeline.sfm.placement import place
from pipeline.sfm.quiet import quiet_colmap
from pipeline.sfm.refine import refine

GIVEN_POSES = "or give known poses (sparse/0, transforms.json)"


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
    attempts: what was tried, in order (see ``escalation``).
    georeference: the frame's method, origin and residuals (see ``georeference.Frame``).
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
    attempts: list[AttemptRecord]
    georeference: dict[str, Any]
    decisions: list[str]
    warnings: list[str]


def reconstruct(
    manifest: Manifest,
    database: Path,
    config: schema.Sfm,
    out: Path,
    *,
    threads: int,
    seed: int,
    ground_control: Path | None = None,
) -> SfmReport:
    """Write the largest model to ``out/sparse/0``, where its frame is to ``out/georeference.json``
    and the other models to ``out/other_models/<n>``.

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
        attempt, attempts = map_until_good(
            work,
            config.mapper,
            total,
            config.min_registered_share,
            seed,
            config.max_attempts,
        )
        decisions = [_told(record, total) for record in attempts]
        if attempt.verdict.grade == "failed" or attempt.evidence is None:
            raise _failure(attempt, attempts)
        model, evidence = attempt.models[0], attempt.evidence
        if attempt.verdict.grade == "good" or config.refine_principal_point == "yes":
            refined = refine(
                model,
                radial=config.refine_radial == "auto",
                principal_point=config.refine_principal_point,
            )
            model = refined.model
            decisions += refined.decisions
            # What the reader is told is of the model that is written.
            evidence = gather(model, attempt.database, total)
        else:
            decisions.append("cameras not refined further: weak geometry bends to what is freed")
    frame = place(model, manifest, config.georeference, ground_control)
    decisions += frame.decisions
    warnings += frame.warnings
    others = attempt.models[1:]
    folders = [out / "sparse" / "0"]
    folders += [out / "other_models" / str(index) for index in range(1, len(others) + 1)]
    colors = _read_colors(database.with_name("keypoint_colors.npz"))
    for each, folder_of in zip([model, *others], folders, strict=True):
        if colors is not None:
            color_points(each, colors)
        write_model(each, folder_of)
    write_json(out / "georeference.json", frame.sidecar())

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
        warnings.append(
            f"the reconstruction is weak: {'; '.join(attempt.verdict.reasons)} (what would help: "
            f"{'; '.join(attempt.verdict.remedies)})"
        )
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
        attempts=attempts,
        georeference={
            "method": frame.method,
            "origin": frame.origin,
            "residuals_m": summary(frame.residuals),
        },
        decisions=decisions,
        warnings=warnings,
    )


def _told(record: AttemptRecord, total: int) -> str:
    how = f" ({record.change})" if record.change else ""
    found = f"{record.registered} of {total} photographs" if record.registered else "no model"
    why = f": {'; '.join(record.reasons)}" if record.reasons and record.registered else ""
    taken = "; taken" if record.taken else ""
    return f"{record.mapper} mapping{how}: {found}, {record.verdict}{why}{taken}"


def _failure(attempt: Attempt, attempts: list[AttemptRecord]) -> UserError:
    ways = f" ({len(attempts)} ways were tried)" if len(attempts) > 1 else ""
    return UserError(
        f"no reconstruction{ways}: {'; '.join(attempt.verdict.reasons)}",
        fix="; ".join([*attempt.verdict.remedies, GIVEN_POSES]),
    )


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
