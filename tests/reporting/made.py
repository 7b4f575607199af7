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
    NovelKind,
    NovelPlace,
    NovelViewCoverage,
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
from pipeline.metrics.pose import PoseError
from pipeline.plan.values import StagePlan
from pipeline.reporting.data import (
    Comparison,
    CoverageSection,
    SceneResults,
    TrainedScene,
    TrainingRecord,
)
from pipeline.reporting.metrics import TimedMetrics
from pipeline.scene.reconstruction import Points
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
    names = [f"coverage/{name}.png" for name in ("view_r", "view_t", "next_r", "next_t", "novel_r")]
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
        novel_views=NovelViewCoverage(
            contradicted_share=0.034,
            unseen_share=0.2,
            by_kind={
                "beside": NovelKind(num_views=6, contradicted_share=0.0567, unseen_share=0.25),
                "behind": NovelKind(num_views=4, contradicted_share=0.0, unseen_share=0.125),
            },
            worst=NovelPlace(
                kind="beside",
                near="2.jpg",
                contradicted_share=0.1234,
                unseen_share=0.5,
                world_to_camera=np.eye(4).tolist(),
                render=names[4],
                map=names[4],
            ),
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
    one = ViewMetrics(name="a.jpg", psnr=27.5, ssim=0.9, flip=0.08, lpips=None, render="0.png")
    return Evaluation(
        psnr=27.5,
        ssim=0.9,
        flip=0.08,
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


def metrics(**changes) -> TimedMetrics:
    """Of a scene whose stages are inspect, decode (skipped) and train."""
    views = (("a.jpg", 21.987, 0.7123, 0.2345), ("b.jpg", 33.456, 0.9321, 0.0456))
    measured = [
        ViewMetrics(name=name, psnr=psnr, ssim=ssim, lpips=lpips, render=f"{i}.png")
        for i, (name, psnr, ssim, lpips) in enumerate(views)
    ]
    quality = evaluation(*measured).model_dump(exclude={"model", "warnings", "schema_version"})
    quality["protocol"] |= {"resolution": ("640x480",), "ssim": "a window"}
    facts = {
        "scene": "barn",
        "input": "49 photographs",
        "device": "cpu",
        "psnr": 27.3456,
        "ssim": 0.87654,
        "flip": 0.08765,
        "lpips": 0.12347,
        "lpips_reason": "",
        "num_gaussians": 123456,
        "registered_images": 47,
        "total_images": 49,
        "reprojection_error_px": 0.4567,
        "sfm_verdict": "good",
        "georeference": None,
        "pose_error": PoseError(
            rotation_median_deg=0.0321,
            rotation_mean_deg=0.04,
            centre_median=0.00456,
            centre_mean=0.005,
            centre_relative_median=0.001,
            radius=4.56,
            scale=1.0,
            auc={1.0: 0.9},
            num_common=47,
            num_truth=49,
        ).model_dump(),
        "stages": {
            "inspect": {"wall_s": 12.5, "cpu_s": 23.4, "peak_rss_mb": 345.0, "skipped": False},
            "decode": {"skipped": True},
            "train": {"wall_s": 14.5, "cpu_s": 25.4, "peak_rss_mb": 347.0, "skipped": False},
        },
        "versions": {"torch": "2.13.0"},
        "seed": 17,
        "warnings": ["it is dark", "one photograph was left out", "it is dark"],
    }
    for name, stage in facts["stages"].items():
        stage["reason"] = f"because of {name}"
    return TimedMetrics.model_validate(quality | facts | changes)


def sparse(xyz: np.ndarray, rgb: np.ndarray | None = None) -> Points:
    """Points without errors and tracks."""
    return Points.without_tracks(xyz, np.zeros(xyz.shape, np.uint8) if rgb is None else rgb)


def report(**changes) -> SceneResults:
    rng = np.random.default_rng(0)
    photograph, render = rng.integers(0, 256, (2, 24, 32, 3), dtype=np.uint8)
    mask = np.ones((24, 32), np.uint8)
    mask[:4] = 0
    lengths = rng.integers(2, 9, 300)
    data = SceneResults(
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
        points=Points(
            xyz=rng.normal(size=(300, 3)),
            rgb=rng.integers(0, 256, (300, 3), dtype=np.uint8),
            error=rng.random(300),
            track_start=np.concatenate([[0], np.cumsum(lengths)]),
            track_image_id=np.zeros(lengths.sum(), np.int64),
            track_xy=np.zeros((lengths.sum(), 2)),
        ),
    )
    return dataclasses.replace(data, **changes)
