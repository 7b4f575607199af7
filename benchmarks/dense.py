"""``python -m benchmarks.dense FOLDER``: depth maps of multi-view stereo against the true depths.

Writes two synthetic scenes to ``FOLDER`` unless they are there, reconstructs them with their exact
cameras, and prints the accuracy of the filtered depth maps, their completeness and the CPU time.
All photographs are used.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.record_tables import dense_table
from benchmarks.results import DenseResult
from pipeline.io.colmap import read_model
from pipeline.mvs.dense import reconstruct
from pipeline.mvs.estimate import load_picture
from pipeline.mvs.maps import read_map
from pipeline.mvs.patchmatch import LIBRARY
from pipeline.runtime.memory import peak_memory_mb
from pipeline.scene.views import View, camera_views

# The module that writes a scene, and its options.
SCENES = {
    "demo": ("pipeline.demo", ("--size", "640x480")),
    "town": ("benchmarks.town", ("--photographs", "40")),
}
EXACT_PINHOLES = ("--poses", "colmap", "--distortion", "none")
# A pixel is textured if the standard deviation of the grey levels around it is larger.
WINDOW, MIN_CONTRAST = 11, 4.0
# Relative errors below which pixels are counted.
LIMITS = (0.005, 0.01, 0.02)


def write_scene(folder: Path, scene: str) -> None:
    """Write a scene into ``folder``, unless it is there."""
    if not (folder / "sparse").is_dir():
        module, options = SCENES[scene]
        command = [sys.executable, "-m", module, str(folder)]
        subprocess.run([*command, *options, *EXACT_PINHOLES], check=True)


def textured(grey: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H, W) whether the window around a pixel has contrast."""
    values = grey.astype(np.float32)
    mean = cv2.blur(values, (WINDOW, WINDOW))
    variance = cv2.blur(values * values, (WINDOW, WINDOW)) - mean * mean
    return np.asarray(variance > MIN_CONTRAST**2)


def measure(folder: Path, scene: str, threads: int) -> DenseResult:
    """Reconstruct a scene and compare its depth maps with the truth."""
    model = read_model(folder / "sparse" / "0")
    views = [
        replace(view, image=str(folder / "images" / view.name))
        for view in camera_views(model, None)
    ]
    instruction_set = LIBRARY.build().target  # Before the time is measured.
    with TemporaryDirectory() as name:
        out, start = Path(name) / "out", time.process_time()
        report = reconstruct(views, model, out, Path(name) / "scratch", threads)
        seconds, peak = time.process_time() - start, peak_memory_mb()
        errors = np.concatenate([relative_errors(folder, view, out) for view in views])
    known = np.isfinite(errors)
    return DenseResult(
        scene=scene,
        photographs=len(views),
        pixels=f"{views[0].width}x{views[0].height}",
        median_error=float(np.median(errors[known])),
        within=[float((errors < limit).mean()) for limit in LIMITS],
        completeness=float(known.mean()),
        within_known=[float((errors[known] < limit).mean()) for limit in LIMITS],
        points=report.counters.dense_points,
        instruction_set=instruction_set,
        cpu_s_per_photograph=seconds / len(views),
        peak_mb=peak,
    )


def relative_errors(folder: Path, view: View, out: Path) -> NDArray[np.float64]:
    """Relative depth errors of a view's textured pixels that see a surface; inf without a depth."""
    stem = Path(view.name).stem
    truth = np.load(folder / "depth_gt" / f"{stem}.npy").astype(np.float64)
    chosen = textured(load_picture(view).grey) & (truth > 0)
    found = read_map(out, view.name).depth[chosen].astype(np.float64)
    return np.where(found > 0, np.abs(found / truth[chosen] - 1), np.inf)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.dense", description=__doc__)
    parser.add_argument("folder", type=Path, help="for the scenes")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--threads", type=int, default=1)
    add_record_options(parser)
    options = parser.parse_args(arguments)
    results = []
    for scene in options.scenes:
        write_scene(options.folder / scene, scene)
        results.append(measure(options.folder / scene, scene, options.threads))
    print(dense_table(results))
    if options.json:
        write_record(options.json, measured("dense", options.note, arguments), results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
