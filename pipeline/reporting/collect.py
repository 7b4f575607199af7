"""``metrics.json``: what a scene's stages recorded, put together."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pipeline.runtime.job import read_stage


def collect_metrics(
    scene: str,
    plan: dict[str, Any],
    folder: Path,
    evaluation: dict[str, Any],
    own_run: dict[str, Any],
) -> dict[str, Any]:
    """Gather a scene's metrics.

    Args:
        scene: its name.
        plan: ``plan.json``.
        folder: ``results/<scene>``, with the stages' folders.
        evaluation: ``evaluate/evaluation.json``.
        own_run: how the calling stage's run has gone so far (it has no ``run.json`` yet).

    Returns:
        The content of ``metrics.json``; times and memory are this machine's, the rest is the
        same for the same input.
    """
    stages: dict[str, Any] = {}
    warnings: list[str] = list(plan["warnings"])
    counters: dict[str, dict[str, Any]] = {}
    for name, step in plan["stages"].items():
        if not step["run"]:
            stages[name] = _timing(None) | {"skipped": True, "reason": step["reason"]}
            continue
        if name == "report":
            run = own_run
        else:
            record = read_stage(folder / name)
            counters[name] = record["counters"]
            known = plan["warnings"]
            warnings += [f"{name}: {text}" for text in record["warnings"] if text not in known]
            run = read_json(folder / name / "run.json")
        stages[name] = _timing(run) | {"skipped": False, "reason": step["reason"]}
    sfm, refined = counters.get("sfm", {}), counters.get("refine", {})
    photos = counters["inspect"]["photos"]
    return {
        "scene": scene,
        "psnr": evaluation["psnr"],
        "ssim": evaluation["ssim"],
        "lpips": evaluation["lpips"],
        "lpips_reason": evaluation["lpips_reason"],
        "train_psnr": evaluation["train_psnr"],
        "psnr_without_gains": evaluation["psnr_without_gains"],
        "per_view": evaluation["per_view"],
        "protocol": evaluation["protocol"],
        "num_gaussians": counters["train"]["num_gaussians"],
        "registered_images": sfm.get("registered", counters["inspect"].get("given_poses")),
        "total_images": photos + counters["inspect"]["left_out"],
        "reprojection_error_px": sfm.get("mean_reprojection_error_px", refined.get("error_px")),
        "sfm_verdict": sfm.get("verdict"),
        "georeference": sfm.get("georeference"),
        "pose_error": evaluation["pose_error"],
        "stages": stages,
        "versions": own_run["versions"],
        "seed": own_run["seed"],
        "warnings": warnings,
    }


def read_json(path: Path) -> Any:
    return json.loads(path.read_text())


def _timing(run: dict[str, Any] | None) -> dict[str, Any]:
    if run is None:
        return {"wall_s": 0.0, "cpu_s": 0.0, "peak_rss_mb": 0.0}
    # Work that was killed and resumed counts its earlier processes, too.
    wall = round(run["wall_s"] + run.get("earlier_s", 0.0), 3)
    return {"wall_s": wall, "cpu_s": run["cpu_s"], "peak_rss_mb": run["peak_rss_mb"]}
