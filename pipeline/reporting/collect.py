"""Collects ``metrics.json`` from the records of a scene's stages."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.plan.record import PlanRecord
from pipeline.reporting.metrics import Metrics
from pipeline.runtime.record import read_stage


def collect_metrics(
    scene: str,
    plan: PlanRecord,
    folder: Path,
    evaluation: Mapping[str, Any],
    *,
    seed: int,
    versions: dict[str, str],
) -> Metrics:
    """Gather a scene's metrics.

    Args:
        scene: name of the scene.
        plan: of the scene.
        folder: ``results/<scene>``, which contains the folders of the stages.
        evaluation: ``evaluate/evaluation.json``.
        seed: of the run.
        versions: of the packages that affect results.

    Raises:
        UserError: a stage's record is missing or damaged.
    """
    warnings: list[str] = list(plan.warnings)
    counters: dict[str, dict[str, Any]] = {}
    for name, step in plan.stages.items():
        if not step.run or name == "report":
            continue
        record = read_stage(folder / name)
        counters[name] = record.counters
        warnings += [f"{name}: {text}" for text in record.warnings if text not in plan.warnings]
    inspect, sfm, refined = (counters.get(name, {}) for name in ("inspect", "sfm", "refine"))
    return Metrics.model_validate(
        {
            "scene": scene,
            **{name: evaluation[name] for name in Metrics.model_fields if name in evaluation},
            "num_gaussians": counters["train"]["num_gaussians"],
            "registered_images": sfm.get("registered", inspect.get("given_poses")),
            "total_images": inspect["photos"] + inspect["left_out"],
            "reprojection_error_px": sfm.get("mean_reprojection_error_px", refined.get("error_px")),
            "sfm_verdict": sfm.get("verdict"),
            "georeference": sfm.get("georeference"),
            "stages": {
                name: {"skipped": not step.run, "reason": step.reason}
                for name, step in plan.stages.items()
            },
            "versions": versions,
            "seed": seed,
            "warnings": warnings,
        }
    )
