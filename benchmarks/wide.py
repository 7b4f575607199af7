"""``python -m benchmarks.wide FOLDER``: the demo scene from panoramas, fisheye and pinhole
photographs of about equally many pixels, reconstructed from bare photographs and compared with the
truth.

Writes the scenes to ``FOLDER/data``, runs snakemake, and prints the pose errors, the PSNR of the
test views and the share of the photographs' pixels that some view shows.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.record_tables import lenses
from benchmarks.results import WideResult
from pipeline.demo.write import DemoSpec, write_demo
from pipeline.metrics.evaluation import Evaluation
from pipeline.runtime.record import read_stage

ROOT = Path(__file__).resolve().parents[1]
VIEWS = 24
# Scene -> lens in words, and the scene.
SCENES = {
    "wide_pinhole": (
        "pinhole with radial distortion",
        DemoSpec(views=VIEWS, width=732, height=548, distortion="simple_radial"),
    ),
    "wide_panorama": (
        "panorama of 360 degrees",
        DemoSpec(views=VIEWS, width=896, height=448, distortion="equirectangular"),
    ),
    "wide_fisheye": (
        "fisheye of 190 degrees",
        DemoSpec(views=VIEWS, width=720, height=720, distortion="fisheye_190"),
    ),
}


def finished(folder: Path, scene: str) -> WideResult:
    """The result of a finished scene."""
    lens, spec = SCENES[scene]
    results = folder / "results" / scene
    evaluation = Evaluation.read(results / "evaluate")
    sfm, undistort = (read_stage(results / name).counters for name in ("sfm", "undistort"))
    error = evaluation.pose_error
    assert error is not None and error.rotation_median_deg is not None
    assert error.rotation_mean_deg is not None and error.centre_relative_median is not None
    return WideResult(
        lens=lens,
        pixels=f"{spec.width}x{spec.height}",
        photographs=sfm["total"],
        registered=sfm["registered"],
        views=undistort.get("views") or sfm["registered"],
        rotation_median_deg=error.rotation_median_deg,
        rotation_mean_deg=error.rotation_mean_deg,
        centre_relative_median=error.centre_relative_median,
        psnr=evaluation.psnr,
        ssim=evaluation.ssim,
        used_share=undistort.get("used_share"),
    )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.wide", description=__doc__)
    parser.add_argument("folder", type=Path, help="for the scenes and their results")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--cores", default="2")
    add_record_options(parser)
    options = parser.parse_args(arguments)
    folder = options.folder.resolve()
    for scene, (_, spec) in SCENES.items():
        if not (folder / "data" / scene / "demo.json").exists():
            write_demo(folder / "data" / scene, spec, None)
    command = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile")]
    command += ["--directory", str(folder), "--cores", options.cores, "--keep-going"]
    command += [f"results/{scene}/metrics.json" for scene in SCENES]
    command += ["--config", f"preset={options.preset}", f"data_root={folder / 'data'}"]
    code = subprocess.run(command, check=False).returncode
    ended = [
        scene
        for scene in SCENES
        if (folder / "results" / scene / "evaluate" / Evaluation.file_name).exists()
    ]
    results = [finished(folder, scene) for scene in ended]
    print(lenses(results))
    if options.json is not None and code == 0:
        write_record(options.json, measured("wide", options.note, arguments), results)
    return code


if __name__ == "__main__":
    sys.exit(main())
