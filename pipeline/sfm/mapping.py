"""Sparse reconstruction: from verified matches to camera poses and points.

Imports pycolmap and must not be imported in a process that uses torch (see ``isolate``).
"""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap

from pipeline.config import settled
from pipeline.runtime.counters import Report
from pipeline.runtime.errors import UserError
from pipeline.runtime.text import counted
from pipeline.scene.georeference import Georeference
from pipeline.scene.manifest import Manifest
from pipeline.sfm.alignment import align_model
from pipeline.sfm.attempts import Attempt, map_until_good
from pipeline.sfm.components import Capture, Component, find_components
from pipeline.sfm.continuity import sequence_steps
from pipeline.sfm.counters import AttemptRecord, CameraSummary, SfmCounters
from pipeline.sfm.evidence import focal_priors
from pipeline.sfm.gaps import find_gaps
from pipeline.sfm.judge import Verdict
from pipeline.sfm.last_adjustment import adjust_last
from pipeline.sfm.matching import COLORS_FILE, list_names
from pipeline.sfm.models import Colors, color_points, quiet_colmap, write_model
from pipeline.sfm.refine import refine
from pipeline.sfm.uncertain import MAX_BASELINE_SHARE, with_uncertainty
from pipeline.sfm.uncertainty import estimate_uncertainty
from pipeline.sfm.uncertainty_file import Uncertainty
from pipeline.sfm.weak import refine_weak

USED_FOLDER = "sparse/0"
OVERLAP = "take photographs that show parts of both"
KNOWN_POSES_HINT = "or give known poses (sparse/0, transforms.json)"


@dataclass(frozen=True)
class MappedScene:
    """Result of the sfm stage.

    Attributes:
        report: The counters and messages of the stage.
        models: The models by their folders, with coloured points.
        georeference: The world frame of the model that is used.
        uncertainty: That of its poses; None if it is not computed.
    """

    report: Report[SfmCounters]
    models: dict[str, pycolmap.Reconstruction]
    georeference: Georeference
    uncertainty: Uncertainty | None

    def write(self, out: Path) -> None:
        """Write the model to ``out/sparse/0``, the other components to ``out/other_models/<n>``,
        the world frame to ``out/georeference.json`` and ``out/uncertainty.json``."""
        for folder, model in self.models.items():
            write_model(model, out / folder)
        self.georeference.write(out)
        if self.uncertainty:
            self.uncertainty.write(out)


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
        database: The database that ``match_features`` wrote; not changed. ``COLORS_FILE``
            beside it gives the points' colours.
        config: The settled options.
        ground_control: The scene's ``gcp_list.txt``; None without one.

    Raises:
        UserError: Every attempt failed the quality check (see ``judge``), or there is no component
            of the number ``sfm.component``.
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
        share = config.min_registered_share
        capture = Capture(attempt.database, total, share, seed, tuple(steps), work)
        components, more = find_components(attempt, capture, partial(_refined, config, capture))
        chosen, chosen_by = _choose(components, capture, config)
        decisions += more + chosen_by
        if chosen is None or chosen.verdict.grade == "failed":
            raise _failure(chosen or attempt, attempts, components)
        components[config.component] = chosen
        gaps = find_gaps(capture.database, components, config.component)
        priors = focal_priors(capture.database)
    model = chosen.model
    frame = align_model(model, manifest, config.georeference, ground_control)
    uncertainty = estimate_uncertainty(model, priors)
    pose_uncertainty = uncertainty.summary(MAX_BASELINE_SHARE) if uncertainty else None
    verdict, doubts = with_uncertainty(chosen.verdict, pose_uncertainty, len(chosen.photographs))
    if colors := _read_colors(database.with_name(COLORS_FILE)):
        for component in components:
            color_points(component.model, colors)
    registered = {model.image(i).name for i in model.reg_image_ids()}
    georeference = frame.georeference()
    counters = SfmCounters(
        mapper=attempt.mapper,
        registered=len(registered),
        total=total,
        not_registered=[p.name for p in manifest.photos if p.name not in registered],
        mean_reprojection_error_px=float(model.compute_mean_reprojection_error()),
        num_points=int(model.num_points3D()),
        mean_track_length=float(model.compute_mean_track_length()),
        components=[
            component.summary(_folder(index, config.component))
            for index, component in enumerate(components)
        ],
        gaps=gaps,
        cameras=_camera_summaries(model, priors, uncertainty),
        uncertainty=pose_uncertainty,
        verdict=verdict.grade,
        evidence=chosen.evidence,
        attempts=attempts,
        georeference=georeference.summary(),
    )
    warnings += [*frame.warnings, *doubts, *_warnings(counters, verdict, config.component)]
    return MappedScene(
        Report(counters, decisions + frame.decisions, warnings),
        {_folder(i, config.component): each.model for i, each in enumerate(components)},
        georeference,
        uncertainty,
    )


def _folder(component: int, used: int) -> str:
    return USED_FOLDER if component == used else f"other_models/{component}"


def _refined(
    config: settled.Sfm, capture: Capture, component: Component
) -> tuple[Component, list[str]]:
    """The component with refined cameras, and the decisions."""
    alone = component.alone.grade
    if alone == "good" or config.refine_principal_point == "yes":
        refined = refine(component.model, principal_point=config.refine_principal_point)
        model, last = adjust_last(refined.model, capture.database, refined.free_principal_points)
        decisions = [*refined.decisions, last]
    else:
        refined = refine_weak(component.model, focal_priors(capture.database))
        model, decisions = refined.model, refined.decisions
    # The report describes the refined model.
    found = capture.judged(model, component.evidence)
    if alone == "good":
        return replace(found, verdict=component.verdict), decisions
    # A focal length that was set to that of EXIF is no evidence that it is right.
    evidence = found.evidence.model_copy(update={"focal_off": component.evidence.focal_off})
    return Component(found.model, evidence, capture.verdict(evidence)), decisions


def _choose(
    components: list[Component], capture: Capture, config: settled.Sfm
) -> tuple[Component | None, list[str]]:
    """The component that is used, complete, and the decisions; None without a model.

    Raises:
        UserError: ``sfm.component`` is larger than the number of components allows.
    """
    index = config.component
    if index == 0:
        return (components[0] if components else None), []
    if index >= len(components):
        raise UserError(
            f"sfm.component is {index}, but the photographs gave "
            f"{counted(len(components), 'component')}",
            fix=f"set sfm.component to a number below {max(len(components), 1)}",
        )
    # It was chosen in spite of its share of the photographs.
    any_share = replace(capture, min_share=0.0)
    chosen = any_share.judged(components[index].model)
    if chosen.verdict.grade == "failed":
        return chosen, []
    chosen, decisions = _refined(config, any_share, chosen)
    chosen, _, more = any_share.completed(chosen, [])
    size = counted(len(chosen.photographs), "photograph")
    return chosen, [f"component {index} of {size} is used (sfm.component)", *decisions, *more]


def _warnings(counters: SfmCounters, verdict: Verdict, used: int) -> Iterator[str]:
    if missing := counters.not_registered:
        yield f"{len(missing)} of {counters.total} photographs have no pose: {list_names(missing)}"
    if len(counters.components) > 1:
        sizes = ", ".join(
            f"{index}: {counted(len(component.photographs), 'photograph')}"
            for index, component in enumerate(counters.components)
        )
        yield (
            f"the photographs gave {len(counters.components)} components that could not be joined "
            f"({sizes}); component {used} is used, the others are in "
            "other_models; set sfm.component to use another one (to improve it: "
            f"{'; '.join(gap.advice() for gap in counters.gaps) or OVERLAP})"
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


def _failure(
    found: Attempt | Component, attempts: list[AttemptRecord], components: list[Component]
) -> UserError:
    count = f" after {len(attempts)} attempts" if len(attempts) > 1 else ""
    usable = [
        f"{index} ({counted(len(component.photographs), 'photograph')})"
        for index, component in enumerate(components)
        if index and component.alone.grade != "failed"
    ]
    other = [f"set sfm.component to use another component: {', '.join(usable)}"] if usable else []
    if components and components[0].alone.grade != "failed":
        other.append("lower sfm.min_registered_share to use component 0")
    return UserError(
        f"no reconstruction{count}: {'; '.join(found.verdict.reasons)}",
        fix="; ".join([*found.verdict.remedies, *other, KNOWN_POSES_HINT]),
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
    model: pycolmap.Reconstruction, priors: Mapping[int, float], uncertainty: Uncertainty | None
) -> list[CameraSummary]:
    """The cameras of registered images; ``priors``: camera id -> focal length from EXIF, pixels."""
    focal = uncertainty.focal_percent if uncertainty else {}
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
            focal_uncertainty_percent=focal.get(camera_id),
        )
        for camera_id, camera in sorted(model.cameras.items())
        if camera_id in count
    ]
