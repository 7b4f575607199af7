"""The Gaussians of a file, of a finished scene, or of a running training."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

from pipeline.io.camera_files import read_cameras
from pipeline.io.splat_files import is_exported, read_gaussians
from pipeline.render.views import near_plane
from pipeline.runtime.errors import UserError
from pipeline.scene.views import camera_views, scene_extent
from pipeline.splats.gaussians import Gaussians
from pipeline.training.checkpoints.checkpoint import PATTERN, newest
from pipeline.training.loop.metrics_log import NAME, read_metrics_log
from pipeline.training.loop.state import gaussians_of


@dataclass(frozen=True)
class Snapshot:
    """A state of a scene.

    Attributes:
        file: The file of the Gaussians.
        stamp: The file's modification time in ns.
        summary: One line for display.
    """

    gaussians: Gaussians
    file: Path
    stamp: int
    summary: str


class Source:
    """Reads the newest Gaussians of a path.

    Args:
        path: A file of Gaussians, or ``results/NAME``, whose training may be running.
        cameras: See ``read_cameras``; None: those of ``results/NAME``.

    Raises:
        UserError: There are no Gaussians yet, or no cameras.
    """

    def __init__(self, path: Path, cameras: Path | None):
        self.path = path
        if cameras is None and not path.is_dir():
            raise UserError(
                "a file of Gaussians contains no cameras", file=path, fix="give --cameras"
            )
        self._file()  # Its absence is the error of a folder that has neither.
        exported = path.is_file() and is_exported(path)
        self.views = camera_views(read_cameras(cameras or path, exported=exported), None)
        self.near = near_plane(scene_extent(self.views))
        self.shown = self._read(None)

    def refresh(self) -> bool:
        """Read the newest state; returns whether it is a newer one."""
        before = self.shown
        # Between two states there may be no file; the next call reads the new one.
        with contextlib.suppress(UserError, OSError):
            self.shown = self._read(before)
        return self.shown is not before

    def _read(self, last: Snapshot | None) -> Snapshot:
        file = self._file()
        stamp = file.stat().st_mtime_ns
        if last is not None and (file, stamp) == (last.file, last.stamp):
            return last
        if file == self.path or file.suffix == ".npz":
            gaussians = read_gaussians(file, [])
            return Snapshot(gaussians, file, stamp, f"{len(gaussians)} Gaussians, trained")
        found = newest(file.parent)
        if found is None:
            raise UserError("no complete checkpoint", file=file.parent, fix="try again in a moment")
        gaussians = gaussians_of(found.arrays)
        return Snapshot(gaussians, file, stamp, self._summary(found.step, len(gaussians)))

    def _file(self) -> Path:
        """The newest of the finished scene and the checkpoints of a running training."""
        if self.path.is_file():
            return self.path
        finished = self.path / "train" / "gaussians.npz"
        found = [finished] if finished.is_file() else []
        found += self.path.glob(f".scratch/train/*/checkpoints/{PATTERN}")
        if not found:
            raise UserError(
                "expected a trained scene or a checkpoint of a training, found neither",
                file=self.path,
                fix="name the results of a scene, as results/NAME; a training writes its first "
                "checkpoint after half a minute",
            )
        return max(found, key=lambda file: file.stat().st_mtime_ns)

    def _summary(self, step: int, count: int) -> str:
        text = f"step {step}, {count} Gaussians"
        lines = read_metrics_log(self.path / "logs" / NAME)
        if lines and lines[-1].psnr is not None:
            text += f", PSNR {lines[-1].psnr:.2f} dB, {lines[-1].share:.0%} done"
        return text
