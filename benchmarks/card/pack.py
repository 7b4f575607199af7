"""Gathers what a bare machine lacks into one folder, for ``python -m benchmarks.card``.

    python -m benchmarks.card.pack FOLDER --export results/bonsai/export \
        --scene results/bonsai/undistort

The machine has Python 3.12 on Linux x86-64, a C++ compiler, torch, numpy, scipy, scikit-image,
opencv-python-headless, pillow and pyyaml. The folder has ``wheels/``, ``loader/`` (Debian packages
of the Vulkan loader), ``sources/`` (gsplat) and ``scene/``: ``point_cloud.spz``, ``images/`` (JPEG)
and ``sparse/0``.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from PIL import Image

from benchmarks.card.__main__ import INSTALLED
from pipeline.io.colmap import read_model, write_model
from pipeline.io.ply import read_splat_ply
from pipeline.io.spz import write_spz
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from pipeline.scene.views import evenly_spaced

MOST_MB = 62.0
QUALITY = 95  # Of the JPEG files.
PYTHON = "3.12"
#: What pip resolves, besides the packages that the machine has.
WHEELS = ("wgpu>=0.32,<0.33", "pydantic>=2.14,<3", "zstandard", "ninja", "jaxtyping", "rich")
#: Dependencies of these that the machine has, and keeps.
PRESENT = ("numpy",)
GSPLAT = "gsplat==1.5.3"
#: NVIDIA's Vulkan driver links the libraries of X11, with or without a display.
LOADER = (
    *("libvulkan1", "libx11-6", "libxext6", "libxcb1", "libxau6", "libxdmcp6"),
    *("libbsd0", "libmd0", "libglvnd0", "libegl1"),
)


def download(folder: Path) -> None:
    """Fill ``wheels/``, ``sources/`` and ``loader/`` from PyPI and the system's packages.

    Raises:
        UserError: A package cannot be downloaded.
    """
    pip = [sys.executable, "-m", "pip", "download", "--quiet"]
    target = ["--python-version", PYTHON, "--only-binary", ":all:"]
    for platform in ("manylinux_2_28_x86_64", "manylinux_2_17_x86_64", "manylinux2014_x86_64"):
        target += ["--platform", platform]
    wheels, sources, loader = (folder / name for name in ("wheels", "sources", "loader"))
    for each in (wheels, sources, loader):
        each.mkdir(parents=True, exist_ok=True)
    _run([*pip, *target, "--dest", str(wheels), *WHEELS])
    for name in PRESENT:
        for file in wheels.glob(f"{name}-*.whl"):
            file.unlink()
    # Without CUDA, its build asks for none: only the sources are stored here.
    _run([*pip, "--no-deps", "--no-binary", ":all:", "--no-build-isolation",
          "--dest", str(sources), GSPLAT], environment={"BUILD_NO_CUDA": "1"})  # fmt: skip
    if shutil.which("apt-get") is None:
        raise UserError("no apt-get", fix="pack on Debian or Ubuntu")
    _run(["apt-get", "download", "-qq", *LOADER], folder=loader)


def _run(
    command: Sequence[str],
    *,
    folder: Path | None = None,
    environment: Mapping[str, str] = MappingProxyType({}),
) -> None:
    variables = {**os.environ, **environment}
    done = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]
        raise UserError(f"{' '.join(command[:6])} ... failed: {' '.join(last)}")


def pack_scene(folder: Path, export: Path, scene: Path, views: int) -> None:
    """Write ``scene/``.

    Args:
        export: The export folder of a finished scene.
        scene: A folder with ``images/`` and their ``sparse/0``.
        views: The largest number of views; they are spread evenly over the capture.

    Raises:
        UserError: A file is missing or malformed.
    """
    if not (export / "point_cloud.ply").is_file():
        raise UserError("expected an export folder with point_cloud.ply", file=export)
    model = read_model(scene / "sparse" / "0")
    out = folder / "scene"
    shutil.rmtree(out, ignore_errors=True)
    (out / "images").mkdir(parents=True, exist_ok=True)
    posed = sorted(model.images.values(), key=lambda image: image.name)
    names = {image.name for image in evenly_spaced(posed, views)}
    ids = [i for i, image in model.images.items() if image.name in names]
    images = {i: replace(model.images[i], name=f"{i:05}.jpg") for i in ids}
    for number in ids:
        file = scene / "images" / model.images[number].name
        with Image.open(file) as image:
            image.convert("RGB").save(out / "images" / images[number].name, quality=QUALITY)
    write_model(out / "sparse" / "0", _of_images(model, images))
    # SPZ is a fraction of the size of PLY, and a frame takes the same time.
    write_spz(out / "point_cloud.spz", read_splat_ply(export / "point_cloud.ply"))


def _of_images(model: Reconstruction, images: dict[int, PosedImage]) -> Reconstruction:
    """The model of some images alone, with the points that two of them observe."""
    points = model.points
    owner = np.repeat(np.arange(len(points)), points.track_length)
    seen = np.isin(points.track_image_id, list(images))
    counts = np.bincount(owner[seen], minlength=len(points))
    kept = counts >= 2
    rows = seen & kept[owner]
    start = np.concatenate([[0], np.cumsum(counts[kept])]).astype(np.int64)
    return Reconstruction(
        model.cameras,
        images,
        Points(
            points.xyz[kept], points.rgb[kept], points.error[kept], start,
            points.track_image_id[rows], points.track_xy[rows],
        ),
    )  # fmt: skip


def size_mb(folder: Path) -> float:
    """The size of all files of a folder, MB.

    Raises:
        UserError: It is above ``MOST_MB``.
    """
    total = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6
    if total > MOST_MB:
        raise UserError(
            f"the pack has {total:.1f} MB, at most {MOST_MB:.0f} fit", fix="lower --views"
        )
    return total


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.card.pack",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--export", type=Path, required=True, help="export of a finished scene")
    parser.add_argument("--scene", type=Path, required=True, help="folder of images and sparse/0")
    parser.add_argument("--views", type=int, default=150, help="at most (default: 150)")
    options = parser.parse_args(arguments)
    # What ``benchmarks.card`` has installed there is of the pack before.
    shutil.rmtree(options.folder / INSTALLED, ignore_errors=True)
    try:
        pack_scene(options.folder, options.export, options.scene, options.views)
        download(options.folder)
        print(f"{options.folder}: {size_mb(options.folder):.1f} MB")
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USER_ERROR
    return 0


if __name__ == "__main__":
    sys.exit(main())
