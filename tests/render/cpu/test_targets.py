"""Every instruction-set target by the compiler in use (CXX, or g++) against the float64 reference.

A target that this processor lacks is emulated (aarch64) or compiled only (x86-64-v4), which the
skip's reason says. Compilers and the emulator may be missing on a user's machine; with
SPLATMAKE_REQUIRE_ALL set, as in CI, a missing one fails.
"""

from __future__ import annotations

import os
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.render import (
    AdamRates,
    Moments,
    RasterCamera,
    RasterOptions,
    reference,
    reference_adam,
)
from pipeline.render.cpu import build
from pipeline.runtime import processor, targets
from tests.render.cpu.compiled import compiled, linked_driver
from tests.render.scenes import NAMES, Scene, camera, random_scene, relative
from tests.tools import need, unsupported

COMPILER = os.environ.get("CXX") or "g++"

# As in test_kernels.py; without fused multiply-add the rounding errors are larger.
COLOR, DEPTH, MEDIAN, RADIUS, GRADIENT = 2e-6, 2e-5, 1e-5, 1e-4, 1e-5
CASES = [
    (1, 700, (97, 53), RasterOptions(background=(0.2, 0.5, 0.9), threads=2)),
    (2, 500, (71, 50), RasterOptions(antialias=True, background=(0.0, 0.0, 0.0), threads=1)),
    (7, 900, (45, 38), RasterOptions(background=(0.9, 0.1, 0.4), threads=3)),
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


@dataclass(frozen=True)
class Case:
    """A scene, a view and the results of the reference."""

    scene: Scene
    cam: RasterCamera
    options: RasterOptions
    incoming: list[torch.Tensor]  # dL/d of color, alpha and depth, then the loss's target
    sure: torch.Tensor
    projection: reference.Projection
    image: reference.Blend
    gradients: list[torch.Tensor]  # of the scene's fields and means2d
    camera_gradient: torch.Tensor

    def write(self, path: Path) -> None:
        cam, options = self.cam, self.options
        pose = cam.world_to_camera.double().numpy()
        header = struct.pack(
            "6q20d",
            *(len(self.scene[0]), 3, cam.width, cam.height),
            *(options.antialias, options.threads),
            *(cam.fx, cam.fy, cam.cx, cam.cy, *pose[:3, :3].ravel(), *pose[:3, 3]),
            *(options.near, *(options.background or (0.0, 0.0, 0.0))),
        )
        arrays = [t.float().contiguous().numpy().tobytes() for t in (*self.scene, *self.incoming)]
        path.write_bytes(header + b"".join(arrays))

    def read(self, path: Path) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """The driver's float32 results by name, and the camera's gradient."""
        pixels, n = (self.cam.height, self.cam.width), len(self.scene[0])
        shapes = {
            **{"color": (*pixels, 3), "alpha": pixels, "depth": pixels, "median": pixels},
            **{"radii": (n,)},
            **{name: t.shape for name, t in zip(NAMES, self.scene, strict=True)},
            **{"means2d": (n, 2), "loss": (*pixels, 3)},
            **{"moved": self.scene[4].shape},
        }
        data, found, start = path.read_bytes(), {}, 0
        for name, shape in shapes.items():
            count = int(np.prod(shape))
            values = np.frombuffer(data, np.float32, count, start).reshape(shape).copy()
            found[name], start = torch.from_numpy(values), start + 4 * count
        return found, torch.from_numpy(np.frombuffer(data, np.float64, 10, start).copy())


def make_case(seed: int, count: int, size: tuple[int, int], options: RasterOptions) -> Case:
    scene, cam = random_scene(seed, count), camera(*size, rotated=seed % 2 == 1)
    inputs = [t.double().requires_grad_() for t in scene]
    change = torch.zeros(10, dtype=torch.float64, requires_grad=True)
    moved = reference.perturbed(cam, change)
    projection, image = reference.render(*inputs, moved, options)
    sure = image.margin > 1e-5
    assert sure.double().mean() > 0.99
    gen = torch.Generator().manual_seed(seed + 100)
    d_color, d_alpha, d_depth = (
        torch.randn(part.shape, generator=gen) * sure.reshape(*sure.shape, *[1] * (part.dim() - 2))
        for part in (image.color, image.alpha, image.depth)
    )
    target = torch.rand(image.color.shape, generator=gen)
    total = (image.color * d_color).sum() + (image.alpha * d_alpha).sum()
    total = total + (image.depth * d_depth).sum()
    *expected, d_camera = torch.autograd.grad(total, [*inputs, projection.means2d, change])
    incoming = [d_color, d_alpha, d_depth, target]
    return Case(scene, cam, options, incoming, sure, projection, image, expected, d_camera)


@pytest.fixture(scope="module")
def cases() -> list[Case]:
    return [make_case(*case) for case in CASES]


def check(case: Case, found: dict[str, torch.Tensor], found_camera: torch.Tensor) -> None:
    """Check the tolerances of test_kernels.py and test_loss_adam.py."""
    image, sure, index = case.image, case.sure, case.projection.index
    assert torch.equal(torch.nonzero(found["radii"])[:, 0], index)
    assert (found["radii"] - case.projection.radii).abs().max() <= RADIUS
    assert (found["color"] - image.color).abs().amax(-1)[sure].max() <= COLOR
    assert (found["alpha"] - image.alpha).abs()[sure].max() <= COLOR
    assert (found["depth"] - image.depth).abs()[sure].max() <= DEPTH
    assert (found["median"] - image.median_depth).abs()[sure].max() <= MEDIAN
    for name, value in zip(NAMES, case.gradients, strict=False):
        assert relative(found[name], value) <= GRADIENT, name
    assert relative(found["means2d"][index], case.gradients[5]) <= GRADIENT
    for part in (slice(0, 3), slice(3, 6), slice(6, 8), slice(8, 10)):
        assert relative(found_camera[part], case.camera_gradient[part]) <= GRADIENT, part

    rendered = found["color"].double().requires_grad_()
    loss, _, _ = reference.l1_ssim(rendered, case.incoming[3], 0.2, None, 2.5)
    assert relative(found["loss"], torch.autograd.grad(loss, rendered)[0]) <= GRADIENT
    sh, d_sh = case.scene[4].double(), found["sh"].double()
    moments = Moments(torch.zeros_like(sh), torch.zeros_like(sh))
    reference_adam.adam_step(sh, d_sh, moments, AdamRates(1e-2, 1))
    assert (found["moved"] - sh).abs().max() <= 2e-6


@pytest.mark.slow
@pytest.mark.parametrize("target", [target.name for target in targets.TARGETS])
def test_every_target_matches_the_reference(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, cases: list[Case], target: str
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
    for case in cases:
        case.write(tmp_path / "in")
        subprocess.run([*emulator, driver, tmp_path / "in", tmp_path / "out"], check=True)
        check(case, *case.read(tmp_path / "out"))
    done = subprocess.run([*emulator, driver], capture_output=True, text=True, timeout=600)
    assert done.stdout.strip() == "clean", done.stdout + done.stderr
