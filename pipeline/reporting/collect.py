"""Collects ``metrics.json`` from the records of a scene's stages."""

from __future__ import annotations

from pathlib import Path

from pipeline.export.counters import ExportCounters
from pipeline.holes.record import HolesRecord
from pipeline.metrics.evaluation import Evaluation, SceneQuality
from pipeline.photos.counters import DecodeCounters, InspectCounters
from pipeline.plan.record import PlanRecord
from pipeline.plan.summary import found
from pipeline.reporting.metrics import Metrics
from pipeline.runtime.counters import read_counters
from pipeline.runtime.record import read_stage
from pipeline.sfm.counters import RefineCounters, SfmCounters
from pipeline.training.loop.counters import TrainCounters


def collect_metrics(
    scene: str,
    plan: PlanRecord,
    folder: Path,
    evaluation: Evaluation,
    *,
    seed: int,
    versions: dict[str, str],
) -> Metrics:
    """Gather a scene's metrics.

    Args:
        scene: The name of the scene.
        plan: The plan of the scene.
        folder: ``results/<scene>``, which contains the folders of the stages.
        evaluation: The result of the evaluate stage.
        seed: The seed of the run.
        versions: The versions of the packages that affect results.

    Raises:
        UserError: a stage's record is missing or damaged, or its counters are.
    """
    ran = [name for name, step in plan.stages.items() if step.run and name != "report"]
    folders = [job for name in ran for job in plan.stages[name].folders(name)]
    warnings = list(plan.warnings)
    for name in folders:
        told = read_stage(folder / name).warnings
        warnings += [f"{name}: {text}" for text in told if text not in plan.warnings]
    inspect = read_counters(folder / "inspect", InspectCounters)
    train = read_counters(folder / "train", TrainCounters)
    sfm = read_counters(folder / "sfm", SfmCounters) if "sfm" in ran else None
    refined = read_counters(folder / "refine", RefineCounters) if "refine" in ran else None
    decoded = read_counters(folder / "decode", DecodeCounters) if "decode" in ran else None
    exported = read_counters(folder / "export", ExportCounters) if "export" in ran else None
    frames = sum((decoded.frames_chosen or {}).values()) if decoded else 0
    error_px = refined.error_px if refined else None
    return Metrics.model_validate(
        {
            "scene": scene,
            "input": found(plan.facts, frames if decoded and plan.facts.videos else None),
            **{name: getattr(evaluation, name) for name in SceneQuality.model_fields},
            "num_gaussians": train.num_gaussians,
            "invented": HolesRecord.read(folder / "holes").summary() if "holes" in ran else None,
            "device": train.device,
            "registered_images": sfm.registered if sfm else inspect.given_poses,
            "total_images": inspect.photos + inspect.left_out + frames,
            "reprojection_error_px": sfm.mean_reprojection_error_px if sfm else error_px,
            "sfm_verdict": sfm.verdict if sfm else None,
            "pose_uncertainty": sfm.uncertainty if sfm else None,
            "georeference": sfm.georeference if sfm else None,
            "components": sfm.components if sfm else [],
            "gaps": sfm.gaps if sfm else [],
            "exported": exported.losses if exported else [],
            "stages": {
                name: {"skipped": not step.run, "reason": step.reason, "jobs": step.jobs}
                for name, step in plan.stages.items()
            },
            "versions": versions,
            "seed": seed,
            "warnings": warnings,
        }
    )
