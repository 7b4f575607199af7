"""Sparse reconstruction: from verified matches to camera poses and points.

Imports pycolmap and must not be imported in a process that uses torch (see ``isolate``).
"""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from pipeline.config import settled
from pipeline.runtime.counters import Report
from pipeline.runtime.errors import UserError
from pipeline.scene.georeference import Georeference
from pipeline.scene.manifest import Manifest
from pipeline.sfm.alignment import align_model
from pipeline.sfm.attempts import Attempt, map_until_good
from pipeline.sfm.continuity import sequence_steps
from pipeline.sfm.counters import AttemptRecord, CameraSummary, SfmCounters
from pipeline.sfm.evidence import collect_evidence, focal_priors
from pipeline.sfm.judge import Verdict, judge
from pipeline.sfm.left_out import register_left_out
from pipeline.sfm.matching import list_names
from pipeline.sfm.models import Colors, color_points, quiet_colmap, write_model
from pipeline.sfm.refine import refine

KNOWN_POSES_HINT = "or give known poses (sparse/0, transforms.json)"


@dataclass(frozen=True)
class MappedScene:
    """Result of the sfm stage.

    Attributes:
        report: The counters and messages of the stage.
        models: The models found, with coloured points: the first one is used.
        georeference: The world frame of the first model.
    """

    report: Report[SfmCounters]
    models: list[pycolmap.Reconstruction]
    georeference: Georeference

    def write(self, out: Path) -> None:
        """Write the model to ``out/sparse/0``, the other models to ``out/other_models/<n>`` and the
        world frame to ``out/georeference.json``."""
        for index, model in enumerate(self.models):
            write_model(model, out / (f"other_models/{index}" if index else "sparse/0"))
        self.georeference.write(out)


def reconstruct(
    manifest: Manifest,
    database: Path,
    config: settled.Sfm,
    *,
    seed: int,
    ground_control: Path | None = None,
) -> MappedScene:
    """Map a scene, check the model, refine its cameras and georeference it. Runs on one thread.

    Args:
        database: The database that ``match_features`` wrote; not changed. ``keypoint_colors.npz``
            beside it gives the points' colours.
        config: The settled options.
        ground_control: The scene's ``gcp_list.txt``; None without one.

    Raises:
        UserError: Every attempt failed the quality check (see ``judge``).
    """
    quiet_colmap()
    total, steps = len(manifest.photos), sequence_steps(manifest.photos)
    with tempfile.TemporaryDirectory(prefix="splatmake-sfm-") as folder:
        # Opening a database can change its bytes: work on a copy.
        work = Path(folder) / "database.db"
        shutil.copyfile(database, work)
        warnings = _check_complete(manifest, work)
        attempt, attempts = map_until_good(
            work, config.mapper, total, config.min_registered_share, seed, steps=steps
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
            evidence = collect_evidence(model, attempt.database, total, steps)
        else:
            decisions.append("cameras not refined further: the model is weak and would overfit")
        verdict = attempt.verdict
        more, late = register_left_out(model, attempt.database, seed)
        found = collect_evidence(more, attempt.database, total, steps) if late else evidence
        judged = judge(found, config.min_registered_share)
        if late and judged.grade != "failed":
            model, evidence, verdict = more, found, judged
            decisions.append(f"registered in a second try, with fewer matches: {list_names(late)}")
        cameras = _camera_summaries(model, focal_priors(attempt.database))
    frame = align_model(model, manifest, config.georeference, ground_control)
    models = [model, *attempt.models[1:]]
    if colors := _read_colors(database.with_name("keypoint_colors.npz")):
        for each in models:
            color_points(each, colors)
    registered = {model.image(i).name for i in model.reg_image_ids()}
    missing = [photo.name for photo in manifest.photos if photo.name not in registered]
    sizes = [int(other.num_reg_images()) for other in models[1:]]
    georeference = frame.georeference()
    counters = SfmCounters(
        mapper=attempt.mapper,
        registered=len(registered),
        total=total,
        not_registered=missing,
        mean_reprojection_error_px=float(model.compute_mean_reprojection_error()),
        num_points=int(model.num_points3D()),
        mean_track_length=float(model.compute_mean_track_length()),
        other_models=sizes,
        cameras=cameras,
        verdict=verdict.grade,
        evidence=evidence,
        attempts=attempts,
        georeference=georeference.summary(),
    )
    warnings += [*frame.warnings, *_warnings(counters, verdict)]
    return MappedScene(
        Report(counters, decisions + frame.decisions, warnings), models, georeference
    )


def _warnings(counters: SfmCounters, verdict: Verdict) -> Iterator[str]:
    if missing := counters.not_registered:
        yield f"{len(missing)} of {counters.total} photographs have no pose: {list_names(missing)}"
    if others := counters.other_models:
        yield (
            f"the photographs gave {len(others) + 1} unconnected models: the largest "
            f"({counters.registered} photographs) is used; the others "
            f"({', '.join(map(str, others))}) are in other_models"
        )
    if verdict.grade == "weak":
        yield (
            f"the reconstruction is weak: {'; '.join(verdict.reasons)} (to improve it: "
            f"{'; '.join(verdict.remedies)})"
        )


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
        UserError: Photographs are missing from the database.
    """
    with pycolmap.Database.open(database) as opened:
        counts = {
            image.name: opened.num_keypoints_for_image(image.image_id)
            for image in opened.read_all_images()
        }
    empty = sorted(name for name, count in counts.items() if count == 0)
    missing = [photo.name for photo in manifest.photos if photo.name not in counts]
    if missing:
        raise UserError(
            f"{len(missing)} photographs are not in the database of matches: {list_names(missing)}",
            file=database.name,
            fix="run the features and matches stages again",
        )
    return [f"no features in {list_names(empty)}"] if empty else []


def _read_colors(path: Path) -> Colors:
    if not path.exists():
        return {}
    with np.load(path) as data:
        return {int(key): data[key] for key in data.files}


def _camera_summaries(
    model: pycolmap.Reconstruction, priors: Mapping[int, float]
) -> list[CameraSummary]:
    """The cameras of registered images; ``priors``: camera id -> focal length from EXIF, pixels."""
    count = Counter(model.image(image_id).camera_id for image_id in model.reg_image_ids())
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
