"""The Gaussians of a file, of a finished scene, or of one that is being trained."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

from pipeline.io.camera_files import read_cameras
from pipeline.io.splat_files import read_gaussians
from pipeline.render.views import near_plane
from pipeline.runtime.errors import UserError
from pipeline.scene.views import camera_views, scene_extent
from pipeline.splats.gaussians import Gaussians
from pipeline.training.checkpoints.checkpoint import PATTERN, newest
from pipeline.training.loop.metrics_log import NAME, read_metrics_log
from pipeline.training.loop.state import gaussians_of


@dataclass(frozen=True)
class Shown:
    """A state of a scene.

    Attributes:
        file: where it stands, and ``stamp`` when it was written (ns): a later one is another state.
        told: one line on it, for a person.
    """

    gaussians: Gaussians
    file: Path
    stamp: int
    told: str


class Source:
    """Where the Gaussians come from.

    Args:
        path: a file of Gaussians, or ``results/NAME``, whose training may be under way.
        cameras: see ``read_cameras``; None: those of ``results/NAME``.

    Raises:
        UserError: nothing there to show yet, or no cameras.
    """

    def __init__(self, path: Path, cameras: Path | None):
        self.path = path
        if cameras is None and not path.is_dir():
            raise UserError(
                "a file of Gaussians says nothing about cameras", file=path, fix="give --cameras"
            )
        self.views = camera_views(read_cameras(cameras or path), None)
        self.near = near_plane(scene_extent(self.views))
        self.shown = self._read(None)

    def renew(self) -> bool:
        """Take the newest state; whether there was a newer one."""
        before = self.shown
        # Half-way between two states there may be neither: the next look finds the next one.
        with contextlib.suppress(UserError, OSError):
            self.shown = self._read(before)
        return self.shown is not before

    def _read(self, last: Shown | None) -> Shown:
        file = self._file()
        stamp = file.stat().st_mtime_ns
        if last is not None and (file, stamp) == (last.file, last.stamp):
            return last
        if file == self.path or file.suffix == ".npz":
            gaussians = read_gaussians(file, [])
            return Shown(gaussians, file, stamp, f"{len(gaussians)} Gaussians, trained")
        found = newest(file.parent)
        if found is None:
            raise UserError("no whole checkpoint", file=file.parent, fix="wait a little")
        gaussians = gaussians_of(found.arrays)
        return Shown(gaussians, file, stamp, self._told(found.step, len(gaussians)))

    def _file(self) -> Path:
        """The newest of the finished scene and the checkpoints of a training under way."""
        if self.path.is_file():
            return self.path
        finished = self.path / "train" / "gaussians.npz"
        found = [finished] if finished.is_file() else []
        found += self.path.glob(f".scratch/train/*/checkpoints/{PATTERN}")
        if not found:
            raise UserError(
                "expected a trained scene or a training's checkpoint, found neither",
                file=self.path,
                fix="start the training; its first checkpoint comes after half a minute",
            )
        return max(found, key=lambda file: file.stat().st_mtime_ns)

    def _told(self, step: int, count: int) -> str:
        text = f"step {step}, {count} Gaussians"
        lines = read_metrics_log(self.path / "logs" / NAME)
        if lines and lines[-1]["psnr"] is not None:
            last = lines[-1]
            text += f", PSNR {last['psnr']:.2f} dB, {last['share']:.0%} done"
        return text
