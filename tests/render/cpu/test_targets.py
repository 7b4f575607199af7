"""Every instruction-set target by the compiler in use (CXX, or g++) against the float64 reference.

A target that this processor lacks is emulated (aarch64) or compiled only (x86-64-v4), which the
skip's reason says. Compilers and the emulator may be missing on a user's machine; with
SPLATMAKE_REQUIRE_ALL set, as in CI, a missing one fails.
"""

from __future__ import annotations

import os
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.render import (
    AdamRates,
    Moments,
    RasterOptions,
    reference,
    reference_adam,
)
from pipeline.render.cpu import build
from pipeline.runtime import processor, targets
from tests.render.cpu.compiled import compiled, linked_driver
from tests.render.scenes import NAMES, Case, relative
from tests.tools import need, unsupported

COMPILER = os.environ.get("CXX") or "g++"

CASES = [
    Case(1, 700, (97, 53), RasterOptions(background=(0.2, 0.5, 0.9), threads=2)),
    Case(2, 500, (71, 50), RasterOptions(antialias=True, background=(0.0, 0.0, 0.0), threads=1)),
    Case(7, 900, (45, 38), RasterOptions(background=(0.9, 0.1, 0.4), threads=3)),
    # Large ones, of which many reach behind the camera.
    Case(4, 40, (45, 38), RasterOptions(threads=1), gaussian_size=1.0),
]


def toolchain(compiler: str, target: targets.Target) -> tuple[list[str], list[str]]:
    """The command that compiles for a target, and the one that runs its programs on this machine.
    Skips, or fails, if one of them is missing."""
    need(compiler)
    here = processor.architecture()
    if target.architecture == here:
        return [compiler], []
    if (here, target.name) != ("x86-64", "aarch64"):
        unsupported(f"{target.name} does not run on {here}")
    # Linked statically, so that the emulator needs no libraries. clang++ takes g++'s.
    cross = "aarch64-linux-gnu-g++"
    need(cross, "qemu-aarch64")
    is_clang = "clang" in compiler
    command = [compiler, "--target=aarch64-linux-gnu"] if is_clang else [cross]
    return [*command, "-static"], ["qemu-aarch64"]


def target_of(case: Case) -> torch.Tensor:
    """The target of the loss."""
    shape = case.rendered[1].color.shape
    return torch.rand(shape, generator=torch.Generator().manual_seed(case.seed))


def write(case: Case, path: Path) -> None:
    """Write the driver's input."""
    cam, options = case.camera, case.options
    pose = cam.world_to_camera.double().numpy()
    header = struct.pack(
        "6q20d",
        *(case.count, 3, cam.width, cam.height, options.antialias, options.threads),
        *(cam.fx, cam.fy, cam.cx, cam.cy, *pose[:3, :3].ravel(), *pose[:3, 3]),
        *(options.near, *(options.background or (0.0, 0.0, 0.0))),
    )
    tensors = (*case.scene, *case.incoming, target_of(case))
    path.write_bytes(header + b"".join(t.float().contiguous().numpy().tobytes() for t in tensors))


def read(case: Case, path: Path) -> dict[str, torch.Tensor]:
    """The driver's results by name."""
    pixels, n = (case.camera.height, case.camera.width), case.count
    shapes: dict[str, tuple[int, ...]] = {"color": (*pixels, 3)}
    shapes |= {"alpha": pixels, "depth": pixels, "median_depth": pixels, "radii": (n,)}
    shapes |= {name: tuple(t.shape) for name, t in zip(NAMES, case.scene, strict=True)}
    shapes |= {"means2d": (n, 2), "loss": (*pixels, 3), "moved": tuple(case.scene[4].shape)}
    data, found, start = path.read_bytes(), {}, 0
    for name, shape in shapes.items():
        count = int(np.prod(shape))
        values = np.frombuffer(data, np.float32, count, start).reshape(shape).copy()
        found[name], start = torch.from_numpy(values), start + 4 * count
    camera = np.frombuffer(data, np.float64, 10, start).copy()
    return found | {"camera": torch.from_numpy(camera)}


def check(case: Case, found: dict[str, torch.Tensor]) -> None:
    """Check the tolerances of test_kernels.py and test_loss_adam.py."""
    case.check_images(found)
    case.check_gradients(found, case.incoming)
    rendered = found["color"].double().requires_grad_()
    loss, _, _ = reference.l1_ssim(rendered, target_of(case), 0.2, None, 2.5)
    assert relative(found["loss"], torch.autograd.grad(loss, rendered)[0]) <= 1e-5
    sh, d_sh = case.scene[4].double(), found["sh"].double()
    moments = Moments(torch.zeros_like(sh), torch.zeros_like(sh))
    reference_adam.adam_step(sh, d_sh, moments, AdamRates(1e-2, 1))
    assert (found["moved"] - sh).abs().max() <= 2e-6


@pytest.mark.slow
@pytest.mark.parametrize("target", [target.name for target in targets.TARGETS])
def test_every_target_matches_the_reference(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, target: str
) -> None:
    """Images and gradients equal the reference's, and 300 scenes with arbitrary values give finite
    results."""
    chosen = targets.named(target)
    command, emulator = toolchain(COMPILER, chosen)
    if chosen.architecture == processor.architecture():
        driver = linked_driver(tmp_path_factory, target)
    else:
        driver = compiled(tmp_path_factory, command, build.flags(target)) / "driver"
    if not emulator and chosen.missing:
        unsupported(f"compiled, but the processor lacks {', '.join(chosen.missing)}")
    for case in CASES:
        write(case, tmp_path / "in")
        subprocess.run([*emulator, driver, tmp_path / "in", tmp_path / "out"], check=True)
        check(case, read(case, tmp_path / "out"))
    done = subprocess.run([*emulator, driver], capture_output=True, text=True, timeout=600)
    assert done.stdout.strip() == "clean", done.stdout + done.stderr
