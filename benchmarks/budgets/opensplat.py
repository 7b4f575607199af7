"""OpenSplat on a scene of the product: the same training views at the same size, the same initial
points, and as many steps as it takes in the time. Its model is measured as the product's own.

Its command line: https://github.com/WebODM/OpenSplat (``opensplat --help``).
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Timer

import numpy as np
from PIL import Image

from benchmarks.results import BudgetResult
from pipeline.commands import Rendering, evaluate
from pipeline.geometry.cameras import Camera
from pipeline.io.camera_files import results_normalization
from pipeline.io.colmap import write_model
from pipeline.io.npz import read_npz
from pipeline.metrics.protocol import choose_protocol
from pipeline.photos.load import load_view
from pipeline.plan.posed_scene import posed_scene
from pipeline.runtime.errors import UserError
from pipeline.runtime.machine import machine_facts
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction

# Number of steps of its default schedule: the most it takes.
MOST_STEPS = 30_000
_STEP = re.compile(r"Step (\d+):")
_SH0 = 0.28209479177387814


@dataclass(frozen=True)
class OpenSplat:
    """Attributes:
    executable: the program.
    threads: that it may use.
    """

    executable: Path
    threads: int

    @property
    def name(self) -> str:
        """Name and version.

        Raises:
            UserError: the program does not run.
        """
        try:
            found = subprocess.run(
                [self.executable, "--version"], capture_output=True, text=True, check=True
            )
        except (OSError, subprocess.CalledProcessError) as error:
            raise UserError(
                f"does not run: {error}", file=self.executable, fix="give the path of opensplat"
            ) from None
        return f"OpenSplat {found.stdout.strip() or 'of unknown version'}"

    def command(self, project: Path, steps: int, model: Path) -> list[str]:
        """The command that trains a project for some steps on the CPU."""
        options = ["--cpu", "--keep-crs", "--num-iters", str(steps), "--output", str(model)]
        return [str(self.executable), str(project), *options]

    def steps_within(self, project: Path, minutes: Sequence[float]) -> dict[float, int]:
        """Time from the start in minutes -> number of steps that it takes until then.

        Raises:
            UserError: it takes no step in the shortest time.
        """
        command = self.command(project, MOST_STEPS, project / "unfinished.ply")
        start, reached = time.monotonic(), [(0.0, 0)]
        with self._start(command) as process:
            timer = Timer(60 * max(minutes), process.kill)
            timer.start()
            assert process.stdout is not None
            for line in process.stdout:
                if match := _STEP.search(line):
                    reached.append((time.monotonic() - start, int(match[1])))
            timer.cancel()
        steps = {m: max(n for second, n in reached if second <= 60 * m) for m in minutes}
        if not min(steps.values()):
            raise UserError(
                f"took no step in {min(minutes):g} minutes",
                file=self.executable,
                fix=f"see what it prints: {' '.join(command)}",
            )
        return steps

    def train(self, project: Path, steps: int, model: Path) -> tuple[float, float]:
        """Train, and return wall and CPU seconds.

        Raises:
            UserError: it fails, or writes no model.
        """
        command, start = self.command(project, steps, model), time.monotonic()
        before = os.times()
        with self._start(command) as process:
            output = process.communicate()[0]
        after = os.times()
        if process.returncode or not model.is_file():
            raise UserError(
                f"failed: {output[-500:]}", file=self.executable, fix=f"run {' '.join(command)}"
            )
        spent = after.children_user - before.children_user
        spent += after.children_system - before.children_system
        return time.monotonic() - start, spent

    def _start(self, command: Sequence[str]) -> subprocess.Popen[str]:
        return subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": str(self.threads)},
        )


def write_project(results: Path, project: Path) -> None:
    """The training views of a finished scene as a COLMAP project, at the size of training, in the
    world of exported models; the means of the initial Gaussians are its points.

    Raises:
        UserError: the scene's exposure is modelled, which other programs do not.
    """
    posed = posed_scene(results, None, None, exported=True)
    if posed.gains:
        raise UserError(
            "photographs of different exposure cannot be compared with another trainer",
            file=results,
            fix="add --config 'train={exposure: off}'",
        )
    background = choose_protocol(posed.views, posed.split, posed.train).background
    shutil.rmtree(project, ignore_errors=True)
    (project / "images").mkdir(parents=True)
    cameras, images = {}, {}
    for number, view in enumerate((v for v in posed.views if not v.is_test), 1):
        name = f"{number:06d}.png"
        Image.fromarray(load_view(view).over(background)).save(project / "images" / name)
        params = np.array([view.fx, view.fy, view.cx, view.cy])
        cameras[number] = Camera("PINHOLE", view.width, view.height, params)
        pose = view.world_to_camera
        images[number] = PosedImage(name, number, pose[:3, :3], pose[:3, 3])
    start = read_npz(results / "init" / "gaussians.npz")
    unit = results_normalization(results).without_origin()
    colours = (0.5 + _SH0 * start.sh[:, 0].numpy()).clip(0, 1) * 255
    points = Points.without_tracks(
        unit.to_given(start.means.numpy().astype(np.float64)), colours.round().astype(np.uint8)
    )
    write_model(project / "sparse" / "0", Reconstruction(cameras, images, points))


def measure(
    program: OpenSplat, name: str, steps: int, results: Path, project: Path, ours: BudgetResult
) -> BudgetResult:
    """A point of OpenSplat beside one of the product.

    Args:
        name: of the program, with its version.
        steps: number of steps to train.
        results: of the product's point ``ours``, whose test views are measured.
    """
    model = project / f"{steps}.ply"
    wall, cpu = program.train(project, steps, model)
    load = machine_facts()["load_average"]
    found = evaluate(model, results, None, None, Rendering(None, None, None, program.threads))
    return replace(
        ours,
        trainer=name,
        options=options_text(program),
        steps=steps,
        psnr=found.psnr,
        ssim=found.ssim,
        lpips=found.lpips,
        gaussians=found.model.num_gaussians,
        wall_minutes=wall / 60,
        cpu_minutes=cpu / 60,
        other_cpu_minutes=None,
        threads=program.threads,
        load_average=load,
    )


def options_text(program: OpenSplat) -> str:
    """Its command without paths and number of steps, for the record."""
    return " ".join(program.command(Path("PROJECT"), 0, Path("MODEL"))[1:]).replace(
        " 0 ", " STEPS "
    )
