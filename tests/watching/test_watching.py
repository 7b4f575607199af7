"""Monitoring of a training: newest state, cameras, the page, TensorBoard curves."""

from __future__ import annotations

import os
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from pipeline.command.main import main
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import rotation_to_quat
from pipeline.io.colmap import write_model
from pipeline.io.npz import write_npz
from pipeline.io.ply import write_splat_ply
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import PosedImage, Reconstruction
from pipeline.training.checkpoints import checkpoint
from pipeline.training.checkpoints.checkpoint import Checkpoint
from pipeline.training.loop.metrics_log import NAME, MetricsRecord
from pipeline.watching.server import Page, ViewerFrame, picture_size
from pipeline.watching.source import Source
from tests.tools import need_package
from tests.training.conftest import FOCAL, HEIGHT, WIDTH, ball, camera_at


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A folder of a running training, with cameras."""
    folder = tmp_path / "results" / "ball"
    poses = {}
    for index in range(4):
        pose = camera_at(index * np.pi / 2).world_to_camera
        poses[index + 1] = PosedImage(f"{index}.png", 1, pose[:3, :3], pose[:3, 3])
    camera = Camera("PINHOLE", WIDTH, HEIGHT, np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]))
    write_model(folder / "sfm" / "sparse" / "0", Reconstruction({1: camera}, poses))
    (folder / "plan.json").write_text("{}")
    return folder


def add_checkpoint(scene: Path, step: int, count: int, time: int) -> None:
    arrays = {f"parameter.{k}": v for k, v in ball(count, 1).arrays().items()}
    folder = scene / ".scratch" / "train" / "abc" / "checkpoints"
    file = checkpoint.save(folder, Checkpoint(step, "id", arrays, {}))
    os.utime(file, (time, time))


def add_journal(scene: Path, steps: int) -> None:
    (scene / "logs").mkdir(exist_ok=True)
    lines = [
        MetricsRecord(
            time=1e9 + step,
            step=step,
            share=step / 10,
            seconds=step,
            seconds_left=10 - step,
            loss=1 / step,
            psnr=20 + step,
            num_gaussians=100,
            sh_degree=0,
            resolution=0.5,
            memory_mb=300.0,
        )
        for step in range(1, steps + 1)
    ]
    text = "".join(line.model_dump_json() + "\n" for line in lines)
    (scene / "logs" / NAME).write_text(text + '{"time": 1')


def test_the_newest_state_is_shown(scene: Path) -> None:
    with pytest.raises(UserError, match="found neither"):
        Source(scene, None)
    add_checkpoint(scene, 10, 30, 1000)
    source = Source(scene, None)
    assert source.shown.summary == "step 10, 30 Gaussians"
    assert not source.refresh()
    add_checkpoint(scene, 20, 40, 2000)
    add_journal(scene, 5)
    assert source.refresh()
    assert source.shown.summary == "step 20, 40 Gaussians, PSNR 25.00 dB, 50% done"
    (scene / "train").mkdir()
    write_npz(scene / "train" / "gaussians.npz", ball(50, 1))
    assert source.refresh()
    assert source.shown.summary == "50 Gaussians, trained"
    # Snakemake removes outputs before it recreates them: the last state is still shown.
    (scene / "train" / "gaussians.npz").unlink()
    for file in (scene / ".scratch").rglob("checkpoint_*"):
        file.unlink()
    assert not source.refresh()


def test_a_file_of_gaussians_needs_cameras(scene: Path, tmp_path: Path) -> None:
    file = tmp_path / "scene.ply"
    write_splat_ply(file, ball(20, 1))
    with pytest.raises(UserError, match="contains no cameras"):
        Source(file, None)
    assert len(Source(file, scene).shown.gaussians) == 20


def test_cameras_convert_between_viewer_and_scene() -> None:
    views = [camera_at(angle) for angle in (0.3, 1.7, 4.0)]
    frame = ViewerFrame(views)
    for view in views:
        placed = frame.from_world(view.centre)
        assert np.linalg.norm(placed) <= 1 + 1e-12
        again = frame.view(
            rotation_to_quat(view.world_to_camera[:3, :3].T),
            placed,
            2 * np.arctan(HEIGHT / 2 / FOCAL),
            (WIDTH, HEIGHT),
        )
        np.testing.assert_allclose(again.world_to_camera, view.world_to_camera, atol=1e-12)
        assert again.fx == pytest.approx(FOCAL) == again.fy
        assert (again.cx, again.cy) == (view.cx, view.cy)


@pytest.mark.parametrize(("aspect", "size"), [(2.0, (100, 50)), (0.5, (50, 100)), (1e-4, (1, 100))])
def test_picture_size_follows_the_aspect_ratio(aspect: float, size: tuple[int, int]) -> None:
    assert picture_size(aspect, 100) == size


def test_the_page_is_served_and_renders(scene: Path) -> None:
    need_package("viser")
    add_checkpoint(scene, 10, 30, 1000)
    page = Page(Source(scene, None), host="127.0.0.1", port=18080, side=64, threads=1)
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{page.port}", timeout=30) as answer:
            assert answer.status == 200
        picture = page.render(page.source.views[1])
        assert picture.shape == (HEIGHT, WIDTH, 3)
        assert picture.max() > 50
        start = np.asarray(page.server.initial_camera.position)
        np.testing.assert_allclose(start, page.frame.from_world(page.source.views[1].centre))
    finally:
        page.stop()


def test_curves_are_written_for_tensorboard(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    need_package("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    out = tmp_path / "events"
    assert main(["tensorboard", str(scene.parent), "-o", str(out)]) == 2
    assert "found none" in capsys.readouterr().err
    for steps in (3, 5):
        add_journal(scene, steps)
        assert main(["tensorboard", str(scene.parent), "-o", str(out)]) == 0
        events = EventAccumulator(str(out / "ball")).Reload()
        found = events.Scalars("train/psnr_db")
        assert [(e.step, e.value) for e in found] == [(s, 20.0 + s) for s in range(1, steps + 1)]
        assert found[0].wall_time == 1e9 + 1
