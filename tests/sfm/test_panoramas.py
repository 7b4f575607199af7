"""Structure from motion with panoramas: mapping, refinement and the quality check."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pipeline.runtime.isolate import run_isolated


def mapped(folder: Path) -> dict[str, Any]:
    """Map a synthetic dataset of panoramas, refine and judge it."""
    import numpy as np
    import pycolmap

    from pipeline.sfm.attempts import map_until_good
    from pipeline.sfm.models import quiet_colmap
    from pipeline.sfm.refine import refine

    quiet_colmap()
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_cameras_per_rig=1,
        num_frames_per_rig=8,
        num_points3D=300,
        camera_model_id=pycolmap.CameraModelId.EQUIRECTANGULAR,
        camera_params=[1600.0, 800.0],
        camera_width=1600,
        camera_height=800,
    )
    path = folder / "database.db"
    with pycolmap.Database.open(path) as database:
        truth = pycolmap.synthesize_dataset(options, database)
        pycolmap.synthesize_noise(
            pycolmap.SyntheticNoiseOptions(point2D_stddev=0.3), truth, database
        )
    best, attempts = map_until_good(path, "incremental", 8, 0.5, 0, 3)
    refined = refine(best.models[0], principal_point="if_determined")
    errors = []
    ids = sorted(truth.reg_image_ids())
    for i in ids[1:]:
        angles = []
        for model in (truth, refined.model):
            a, b = (model.image(k).cam_from_world().rotation.matrix() for k in (ids[0], i))
            angles.append(b @ a.T)
        cosine = (np.trace(angles[0] @ angles[1].T) - 1) / 2
        errors.append(float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))))
    assert best.evidence is not None
    return {
        "verdict": best.verdict.grade,
        "attempts": len(attempts),
        "evidence": best.evidence.model_dump(),
        "error": max(errors),
        "freed": refined.freed,
    }


def test_panoramas_are_mapped_and_judged_by_their_rays(tmp_path: Path) -> None:
    found = run_isolated(mapped, tmp_path)
    evidence = found["evidence"]
    assert found["verdict"] == "good" and found["attempts"] == 1, found
    assert evidence["registered"] == 8 and evidence["behind_camera"] == 0
    assert evidence["agreeing_matches"] > 0.97 and evidence["agreeing_pairs"] == 1
    assert evidence["focal_relative"] is None and evidence["parallax"] > 0.01
    assert found["error"] < 0.3 and not found["freed"]


def turned() -> float:
    """``_parallax`` of panoramas that were only turned."""
    import numpy as np
    import pycolmap

    from pipeline.sfm.evidence import _sphere_parallax
    from pipeline.sfm.model_views import ModelView

    rng = np.random.default_rng(0)
    rays = rng.normal(size=(200, 3))
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=1600, height=800, params=[1600, 800])
    views = {}
    for number in (1, 2):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        xy = np.asarray(camera.img_from_cam(rays @ turn.T)).astype(np.float32)
        views[number] = ModelView(
            camera, turn, np.zeros(3), xy.astype(np.float64), np.full(len(rays), -1)
        )
    matches = np.stack([np.arange(200)] * 2, axis=1).astype(np.uint32)
    return _sphere_parallax(views, {(1, 2): matches})


def test_panoramas_that_only_turn_have_no_parallax() -> None:
    assert run_isolated(turned) == pytest.approx(0, abs=1e-5)


def covisibility(folded: bool) -> float:
    """``missing_covisibility`` of photographs and panoramas side by side, which observe six and
    one of ten points. ``folded``: every other photograph observes points of its own."""
    import numpy as np
    import pycolmap

    from pipeline.sfm.consistency import missing_covisibility
    from pipeline.sfm.model_views import ModelView

    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    cameras = [
        pycolmap.Camera(model=kind, width=width, height=480, params=params)
        for kind, width, params in (
            ("PINHOLE", 640, [500, 500, 320, 240]),
            ("EQUIRECTANGULAR", 960, [960, 480]),
        )
    ]
    for xyz in rng.uniform(-0.5, 0.5, (600, 3)):
        model.add_point3D(xyz, pycolmap.Track())
    ids = np.array(sorted(model.points3D))
    views = []
    for number in range(1, 13):
        angle, panorama = np.radians(2.0 * number), number % 3 == 0
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        own = ids[number % 2 :: 2] if folded and not panorama else ids
        seen = rng.choice(own, len(own) * (1 if panorama else 6) // 10, replace=False)
        pose = rotation, np.array([0, 0, 3.0])
        views.append(ModelView(cameras[panorama], *pose, np.zeros((len(seen), 2)), seen))
    return missing_covisibility(model, dict(enumerate(views)))


def test_photographs_among_panoramas_share_few_points_with_them() -> None:
    assert run_isolated(covisibility, False) == 0
    assert run_isolated(covisibility, True) > 0.2
