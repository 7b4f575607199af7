"""Synthetic content of a page."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from pipeline.plan.values import StagePlan
from pipeline.reporting.data import Comparison, Coverage, ReportData, TrainedScene
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from tests.plans import record_of


def ring(count: int = 5, *, width: int = 200, height: int = 150) -> list[View]:
    """Cameras on a ring around the origin, z up, looking inwards; the principal point is
    off-centre, the first camera a test view."""
    views = []
    for i, angle in enumerate(np.linspace(0, 2 * np.pi, count, endpoint=False)):
        forward = -np.array([np.cos(angle), np.sin(angle), 0.0])
        down = np.array([0.0, 0.0, -1.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([np.cross(down, forward), down, forward])
        pose[:3, 3] = -pose[:3, :3] @ (-3 * forward + 0.3 * down)
        intrinsics = (0.9 * width, 0.95 * width, 0.47 * width, 0.54 * height)
        views.append(View(f"{i}.jpg", "", None, width, height, *intrinsics, pose, i == 0))
    return views


def gaussians(count: int = 400, *, degree: int = 3, seed: int = 0) -> Gaussians:
    """Around the origin, of all sizes and opacities, their colours depending on the direction, few
    of them brighter than white: a browser cuts those off one by one, the rasterizer in the sum."""
    gen = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=gen)

    sh = normal(count, (degree + 1) ** 2, 3) * 0.05
    sh[:, 0] += 0.3 * normal(count, 3)
    return Gaussians(
        normal(count, 3) * 0.6,
        normal(count, 3) * 0.5 - 3.3,
        normal(count, 4),
        normal(count) * 1.5 + 0.5,
        sh,
    )


def trained(**changes) -> TrainedScene:
    scene = TrainedScene(gaussians(), ring(), {}, (0.0, 0.0, 0.0), False, 0.03)
    return dataclasses.replace(scene, **changes)


def coverage() -> Coverage:
    rng = np.random.default_rng(1)
    names = [f"coverage/{name}_{kind}.png" for name in ("view_1", "next_1") for kind in "rt"]
    pictures = {
        name: rng.integers(0, 256, (9, 12, 3) if name.endswith("r.png") else (9, 12), np.uint8)
        for name in names
    }
    record = {
        "photographs": 4,
        "looked_at": 4,
        "surface": {
            "seen_by": {"1": 0.0123, "2": 0.0456, "3 or more": 0.9421},
            "median_photographs": 5.0,
            "median_parallax_deg": 41.3,
        },
        "views": [
            {
                "name": "0.jpg",
                "psnr": 18.765,
                "trust": 0.4321,
                "little_trust": 0.6,
                "holes": 0.0321,
                "floating": 0.0077,
                "median_photographs": 3.0,
                "render": names[0],
                "trust_map": names[1],
            }
        ],
        "error": {
            "squares": 1234,
            "square_px": 8,
            "rank_correlation": -0.567,
            "by_trust": [{"trust": [0.0, 0.25], "share": 0.111, "rmse": 0.2222}],
        },
        "floaters": {"gaussians": 13, "within": 0.5, "cameras": {"3.jpg": 13}},
        "surroundings": {"viewpoints": 40, "trust": 0.5, "trust_with_proposals": 0.7},
        "viewpoints": [
            {
                "where": "between 1.jpg and 2.jpg, 0.4 m higher",
                "position": [1.0, 2.0, 0.5],
                "direction": [0.0, -1.0, 0.0],
                "look_at": [0.0, 0.0, 0.0],
                "world_to_camera": np.eye(4).tolist(),
                "unknown_percent": 63.4,
                "gain_percent": 17.2,
                "render": names[2],
                "trust_map": names[3],
            }
        ],
    }
    return Coverage(record, pictures)


def metrics() -> dict:
    names = ("inspect", "decode", "train")
    return {
        "scene": "barn",
        "psnr": 27.3456,
        "ssim": 0.87654,
        "lpips": 0.12347,
        "lpips_reason": "",
        "per_view": [
            {"name": "a.jpg", "psnr": 21.987, "ssim": 0.7123, "lpips": 0.2345, "render": "0.png"},
            {"name": "b.jpg", "psnr": 33.456, "ssim": 0.9321, "lpips": 0.0456, "render": "1.png"},
        ],
        "protocol": {"resolution": ["640x480"], "split": "every 8th", "ssim": "a window"},
        "num_gaussians": 123456,
        "registered_images": 47,
        "total_images": 49,
        "reprojection_error_px": 0.4567,
        "pose_error": {"rotation_median_deg": 0.0321, "centre_median": 0.00456, "auc": {"1": 0.9}},
        "stages": {
            name: {
                "wall_s": 0.0 if name == "decode" else 12.5 + i,
                "cpu_s": 0.0 if name == "decode" else 23.4 + i,
                "peak_rss_mb": 0.0 if name == "decode" else 345.0 + i,
                "skipped": name == "decode",
                "reason": f"because of {name}",
            }
            for i, name in enumerate(names)
        },
        "versions": {"torch": "2.13.0"},
        "seed": 17,
        "warnings": ["one photograph was left out", "it is dark"],
    }


def report(**changes) -> ReportData:
    rng = np.random.default_rng(0)
    photograph, render = rng.integers(0, 256, (2, 24, 32, 3), dtype=np.uint8)
    mask = np.ones((24, 32), np.uint8)
    mask[:4] = 0
    data = ReportData(
        scene="barn",
        metrics=metrics(),
        plan=record_of({"decode": StagePlan(run=False, reason="no RAW")}, ["it is dark"]),
        decisions={"sfm": ["incremental mapper: 49 images"], "train": []},
        curve=[
            {"step": 100, "loss": 0.2345, "psnr": 17.89, "num_gaussians": 5001, "seconds": 3.0},
            {"step": 200, "loss": 0.1234, "psnr": 23.45, "num_gaussians": 7003, "seconds": 7.0},
        ],
        comparisons=[
            Comparison("worst", "a.jpg", photograph, render, mask, 21.987, 0.7123, 6),
            Comparison("best", "b.jpg", photograph, render, None, 33.456, 0.9321),
        ],
        trained=trained(),
        coverage=coverage(),
        points_xyz=rng.normal(size=(300, 3)),
        points_rgb=rng.integers(0, 256, (300, 3), dtype=np.uint8),
        reprojection_errors=rng.random(300),
        track_lengths=rng.integers(2, 9, 300),
    )
    return dataclasses.replace(data, **changes)
