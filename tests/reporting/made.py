"""Synthetic content of a page."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from pipeline.coverage.record import (
    CoverageRecord,
    ErrorByTrust,
    ErrorClass,
    FloaterCoverage,
    ProposedViewpoint,
    SeenBy,
    SurfaceCoverage,
    Surroundings,
    ViewCoverage,
)
from pipeline.metrics.evaluation import (
    EvaluatedModel,
    Evaluation,
    ProtocolDescription,
    ViewMetrics,
)
from pipeline.plan.values import StagePlan
from pipeline.reporting.data import (
    Comparison,
    CoverageSection,
    ReportData,
    TrainedScene,
    TrainingRecord,
)
from pipeline.scene.views import View
from pipeline.splats.arrays import GaussianArrays
from pipeline.splats.gaussians import Gaussians
from pipeline.training.loop.curve import CurveRecord
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


def gaussians(count: int = 400, *, degree: int = 3, seed: int = 0) -> GaussianArrays:
    """Around the origin, of all sizes and opacities, their colours depending on the direction, few
    of them brighter than white: a browser cuts those off one by one, the rasterizer in the sum."""
    gen = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=gen)

    sh = normal(count, (degree + 1) ** 2, 3) * 0.05
    sh[:, 0] += 0.3 * normal(count, 3)
    made = Gaussians(
        normal(count, 3) * 0.6,
        normal(count, 3) * 0.5 - 3.3,
        normal(count, 4),
        normal(count) * 1.5 + 0.5,
        sh,
    )
    return made.as_arrays()


def trained(**changes) -> TrainedScene:
    scene = TrainedScene(gaussians(), ring(), {}, (0.0, 0.0, 0.0), False, 0.03)
    return dataclasses.replace(scene, **changes)


def coverage() -> CoverageSection:
    rng = np.random.default_rng(1)
    names = [f"coverage/{name}_{kind}.png" for name in ("view_1", "next_1") for kind in "rt"]
    pictures = {
        name: rng.integers(0, 256, (9, 12, 3) if name.endswith("r.png") else (9, 12), np.uint8)
        for name in names
    }
    record = CoverageRecord(
        num_training_views=4,
        num_rendered_views=4,
        trust_definition="precision times support",
        surface=SurfaceCoverage(
            seen_by=SeenBy(one=0.0123, two=0.0456, three_or_more=0.9421),
            median_photographs=5.0,
            median_parallax_deg=41.3,
        ),
        views=(
            ViewCoverage(
                name="0.jpg",
                psnr=18.765,
                mean_trust=0.4321,
                low_trust_share=0.6,
                hole_share=0.0321,
                floater_share=0.0077,
                median_photographs=3.0,
                render=names[0],
                trust_map=names[1],
            ),
        ),
        error=ErrorByTrust(
            num_blocks=1234,
            block_px=8,
            rank_correlation=-0.567,
            by_trust=(ErrorClass(trust_range=(0.0, 0.25), share=0.111, rmse=0.2222),),
        ),
        floaters=FloaterCoverage(num_gaussians=13, search_distance=0.5, by_camera={"3.jpg": 13}),
        surroundings=Surroundings(num_viewpoints=40, mean_trust=0.5, mean_trust_with_proposals=0.7),
        viewpoints=(
            ProposedViewpoint(
                description="between 1.jpg and 2.jpg, 0.4 m higher",
                position=(1.0, 2.0, 0.5),
                direction=(0.0, -1.0, 0.0),
                look_at=(0.0, 0.0, 0.0),
                world_to_camera=np.eye(4).tolist(),
                unknown_percent=63.4,
                gain_percent=17.2,
                render=names[2],
                trust_map=names[3],
            ),
        ),
    )
    return CoverageSection(record, pictures)


def evaluation(*views: ViewMetrics) -> Evaluation:
    """With the measures of these views; of one, without arguments."""
    one = ViewMetrics(name="a.jpg", psnr=27.5, ssim=0.9, lpips=None, render="0.png")
    return Evaluation(
        psnr=27.5,
        ssim=0.9,
        lpips=None,
        lpips_reason="switched off",
        train_psnr=30.0,
        psnr_without_gains=None,
        per_view=views or (one,),
        protocol=ProtocolDescription(
            resolution=("80x60",),
            split="every 8th",
            poses_and_points="all",
            num_views=1,
            psnr="mean",
            ssim="mean",
            lpips="switched off",
            masks=None,
            background=(0.0, 0.0, 0.0),
            exposure=None,
            poses=None,
        ),
        model=EvaluatedModel(num_gaussians=1000, sh_degree=3),
        warnings=("there are few photographs",),
    )


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
            TrainingRecord(CurveRecord(step=100, loss=0.2345, psnr=17.89, num_gaussians=5001), 3.0),
            TrainingRecord(CurveRecord(step=200, loss=0.1234, psnr=23.45, num_gaussians=7003), 7.0),
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
