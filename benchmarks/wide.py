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
from pathlib import Path

from pipeline.demo.write import DemoSpec, write_demo
from pipeline.metrics.evaluation import Evaluation
from pipeline.runtime.record import read_stage

ROOT = Path(__file__).resolve().parents[1]
VIEWS = 24
SCENES = {
    "wide_pinhole": DemoSpec(views=VIEWS, width=732, height=548, distortion="simple_radial"),
    "wide_panorama": DemoSpec(views=VIEWS, width=896, height=448, distortion="equirectangular"),
    "wide_fisheye": DemoSpec(views=VIEWS, width=720, height=720, distortion="fisheye_190"),
}


def row(folder: Path, scene: str) -> str:
    """One line of the table."""
    results = folder / "results" / scene
    evaluation = Evaluation.read(results / "evaluate")
    sfm, undistort = (read_stage(results / name).counters for name in ("sfm", "undistort"))
    error, used = evaluation.pose_error, undistort.get("used_share")
    assert error is not None
    views = undistort.get("views") or VIEWS
    return (
        f"{scene:<14} {sfm['registered']:>3}/{sfm['total']:<3} {views:>5} "
        f"{error.rotation_median_deg:>9.4f} {error.rotation_mean_deg:>9.4f} "
        f"{error.centre_median:>9.5f} {evaluation.psnr:>7.2f} {evaluation.ssim:>7.4f} "
        f"{'' if used is None else f'{used:.2%}':>8}"
    )


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.wide", description=__doc__)
    parser.add_argument("folder", type=Path, help="for the scenes and their results")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--cores", default="2")
    options = parser.parse_args(arguments)
    folder = options.folder.resolve()
    for scene, spec in SCENES.items():
        if not (folder / "data" / scene / "demo.json").exists():
            write_demo(folder / "data" / scene, spec, None)
    command = ["snakemake", "-s", str(ROOT / "Snakefile"), "--directory", str(folder)]
    command += ["--cores", options.cores, "--keep-going"]
    command += [f"results/{scene}/metrics.json" for scene in SCENES]
    command += ["--config", f"preset={options.preset}", f"data_root={folder / 'data'}"]
    code = subprocess.run(command, check=False).returncode
    print("scene          poses   views  rot. med  rot. mean    centre    PSNR    SSIM     used")
    for scene in SCENES:
        if (folder / "results" / scene / "evaluate" / Evaluation.file_name).exists():
            print(row(folder, scene))
    return code


if __name__ == "__main__":
    sys.exit(main())
