"""Sparse reconstruction: from verified matches to camera poses and points.

Imports pycolmap and must not be imported in a process that uses torch (see ``isolate``).
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from pipeline.config import settled
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest
from pipeline.sfm.alignment import align_model
from pipeline.sfm.attempts import Attempt, map_until_good
from pipeline.sfm.counters import AttemptRecord, CameraSummary, SfmCounters
from pipeline.sfm.evidence import collect_evidence, focal_priors
from pipeline.sfm.matching import list_names
from pipeline.sfm.models import Colors, color_points, write_model
from pipeline.sfm.quiet import quiet_colmap
from pipeline.sfm.refine import refine

KNOWN_POSES_HINT = "or give known poses (sparse/0, transforms.json)"


@dataclass(frozen=True)
class SfmReport:
    """Result of the sfm stage. ``decisions`` and ``warnings`` are sentences for the log."""

    counters: SfmCounters
    decisions: list[str]
    warnings: list[str]


def reconstruct(
    manifest: Manifest,
    database: Path,
    config: settled.Sfm,
    out: Path,
    *,
    threads: int,
    seed: int,
    ground_control: Path | None = None,
) -> SfmReport:
    """Map a scene, check the model, refine its cameras and georeference it.

    Writes the largest model to ``out/sparse/0``, its world frame to ``out/georeference.json`` and
    the other models to ``out/other_models/<n>``. The files do not depend on ``threads``.

    Args:
        database: database written by ``match_features``; not changed. ``keypoint_colors.npz``
            beside it gives the points' colours.
        config: The settled options.
        ground_control: the scene's ``gcp_list.txt``, None without one.

    Raises:
        UserError: every attempt failed the quality check (see ``judge``).
    """
    quiet_colmap()
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
        )
        decisions = [_describe(record, total) for record in attempts]
        if attempt.verdict.grade == "failed" or attempt.evidence is None:
            raise _failure(attempt, attempts)
        model, evidence = attempt.models[0], attempt.evidence
        if attempt.verdict.grade == "good" or config.refine_principal_point == "yes":
            refined = refine(
                model,
                radial=config.refine_radial,
                principal_point=config.refine_principal_point,
            )
            model = refined.model
            decisions += refined.decisions
            # The report describes the refined model.
            evidence = collect_evidence(model, attempt.database, total)
        else:
            decisions.append("cameras not refined further: the model is weak and would overfit")
        cameras = _camera_summaries(model, focal_priors(attempt.database))
    frame = align_model(model, manifest, config.georeference, ground_control)
    decisions += frame.decisions
    warnings += frame.warnings
    others = attempt.models[1:]
    folders = [out / "sparse" / "0"]
    folders += [out / "other_models" / str(index) for index in range(1, len(others) + 1)]
    colors = _read_colors(database.with_name("keypoint_colors.npz"))
    for written, model_folder in zip([model, *others], folders, strict=True):
        if colors is not None:
            color_points(written, colors)
        write_model(written, model_folder)
    georeference = frame.georeference()
    georeference.write(out)

    registered = {model.image(i).name for i in model.reg_image_ids()}
    missing = [photo.name for photo in manifest.photos if photo.name not in registered]
    if missing:
        warnings.append(
            f"{len(missing)} of {total} photographs have no pose: {list_names(missing)}"
        )
    if others:
        sizes = ", ".join(str(other.num_reg_images()) for other in others)
        warnings.append(
            f"the photographs gave {len(attempt.models)} unconnected models: the largest "
            f"({len(registered)} photographs) is used; the others ({sizes}) are in other_models"
        )
    if attempt.verdict.grade == "weak":
        warnings.append(
            f"the reconstruction is weak: {'; '.join(attempt.verdict.reasons)} (to improve it: "
            f"{'; '.join(attempt.verdict.remedies)})"
        )
    counters = SfmCounters(
        mapper=attempt.mapper,
        registered=len(registered),
        total=total,
        not_registered=missing,
        mean_reprojection_error_px=float(model.compute_mean_reprojection_error()),
        num_points=int(model.num_points3D()),
        mean_track_length=float(model.compute_mean_track_length()),
        other_models=[int(other.num_reg_images()) for other in others],
        cameras=cameras,
        verdict=attempt.verdict.grade,
        evidence=evidence,
        attempts=attempts,
        georeference=georeference.summary(),
    )
    return SfmReport(counters, decisions, warnings)


def _describe(record: AttemptRecord, total: int) -> str:
    change = f" ({record.change})" if record.change else ""
    size = f"{record.registered} of {total} photographs" if record.registered else "no model"
    reasons = f": {'; '.join(record.reasons)}" if record.reasons and record.registered else ""
    taken = "; used" if record.taken else ""
    return f"{record.mapper} mapping{change}: {size}, {record.verdict}{reasons}{taken}"


def _failure(attempt: Attempt, attempts: list[AttemptRecord]) -> UserError:
    count = f" after {len(attempts)} attempts" if len(attempts) > 1 else ""
    return UserError(
        f"no reconstruction{count}: {'; '.join(attempt.verdict.reasons)}",
        fix="; ".join([*attempt.verdict.remedies, KNOWN_POSES_HINT]),
    )


def _check_complete(manifest: Manifest, database: Path) -> list[str]:
    """Check that every photograph is in the database; returns warnings.

    Raises:
        UserError: photographs are missing from the database.
    """
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
            f"{len(missing)} photographs are not in the database of matches: {list_names(missing)}",
            file=database.name,
            fix="run the features and matches stages again",
        )
    return [f"no features in {list_names(sorted(empty))}"] if empty else []


def _read_colors(path: Path) -> Colors | None:
    if not path.exists():
        return None
    with np.load(path) as data:
        return {int(key): data[key] for key in data.files}


def _camera_summaries(
    model: pycolmap.Reconstruction, priors: Mapping[int, float]
) -> list[CameraSummary]:
    """The cameras of registered images; ``priors``: camera id -> focal length from EXIF, pixels."""
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
            focal_prior_px=priors.get(camera_id),
        )
        for camera_id, camera in sorted(model.cameras.items())
        if camera_id in count
    ]
