"""Stress test of the rasterizer with millions of extreme inputs: counts non-finite values, and
compares the float32 kernels with the float64 reference.

    python -m benchmarks.raster_stress --cases 1000000
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import dataclass, field, fields

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # torch's threads, of the reference

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.results import StressResult
from pipeline.render import Backend, RasterCamera, RasterOptions, make_backend, reference
from pipeline.runtime.progress import Progress

PER_CALL = 512  # Gaussians per call; each is a case
SIZES = [(1, 1), (2, 3), (16, 16), (17, 31), (13, 7), (23, 19)]
NAMES = ("means", "log_scales", "quats", "opacity_logits", "sh")
EXTREME = np.array(
    [np.nan, np.inf, -np.inf, 0, -0.0, 1e-45, 1e-38, -1e38, 1e38, 3.4e38, 1e-12, 1e12, 88, -88]
)
# Pixels within MARGIN of a cut-off may differ in float32. Gradients beyond LARGEST are treated as
# overflow: the kernels return zeros.
MARGIN, LARGEST = 1e-4, 1e30

Rng = np.random.Generator


@dataclass
class Case:
    """``PER_CALL`` Gaussians in front of a camera, to be modified by a family of inputs."""

    rng: Rng
    arrays: dict[str, NDArray[np.float64]] = field(init=False)
    size: tuple[int, int] = field(init=False)
    focal: float = 0.9  # image widths
    centre: tuple[float, float] = (0.48, 0.53)  # image sides

    def __post_init__(self) -> None:
        rng, n = self.rng, PER_CALL
        self.size = SIZES[rng.integers(len(SIZES))]
        self.arrays = {
            "means": rng.standard_normal((n, 3)) * [1.4, 1.1, 1.0] + [0, 0, 4],
            "log_scales": rng.standard_normal((n, 3)) * 0.5 + np.log(0.1),
            "quats": rng.standard_normal((n, 4)),
            "opacity_logits": rng.standard_normal(n) * 1.5,
            "sh": rng.standard_normal((n, 16, 3)) * 0.25,
        }

    def some(self) -> NDArray[np.bool_]:
        """About half of the Gaussians."""
        return self.rng.random(PER_CALL) < 0.5

    def between(self, low: float, high: float, *shape: int) -> NDArray[np.float64]:
        return self.rng.uniform(low, high, (PER_CALL, *shape))


def _not_finite(case: Case) -> None:
    for name in case.rng.choice(NAMES, 3):
        flat = case.arrays[name].reshape(PER_CALL, -1)
        for row in np.flatnonzero(case.rng.random(PER_CALL) < 0.1):
            flat[row, case.rng.integers(flat.shape[1])] = case.rng.choice(EXTREME[:3])


def _any_value(case: Case) -> None:
    for name in NAMES:
        flat = case.arrays[name].reshape(-1)
        hit = case.rng.random(flat.size) < 0.03
        flat[hit] = case.rng.choice(EXTREME, hit.sum())


def _quaternions(case: Case) -> None:
    case.arrays["quats"] *= 10.0 ** case.between(-40, 38, 1)
    case.arrays["quats"][case.rng.random(PER_CALL) < 0.2] = 0


def _large_and_small(case: Case) -> None:
    case.arrays["log_scales"] = np.log(10.0) * case.between(-3, 2, 3)


def _scales(case: Case) -> None:
    case.arrays["log_scales"] = np.log(10.0) * case.between(-12, 12, 3)


def _needles(case: Case) -> None:
    thin = case.between(-7, -3, 1)
    case.arrays["log_scales"] = np.log(10.0) * (thin + np.array([6.0, 0, 0]))


def _opacities(case: Case) -> None:
    case.arrays["opacity_logits"] = case.between(-100, 100)


def _near(case: Case) -> None:
    some = case.some()
    case.arrays["means"][some] = case.between(-1, 1, 3)[some] * 10.0 ** case.between(-6, 0, 1)[some]
    case.arrays["means"][some, 2] += case.rng.choice([0.0, 0.01, 0.0100001, 0.02], some.sum())


def _beyond(case: Case) -> None:
    some = case.some()
    case.arrays["means"][some] *= 10.0 ** case.between(0, 8, 1)[some]
    case.arrays["means"][case.rng.random(PER_CALL) < 0.2, 2] *= -1


def _one_pixel(case: Case) -> None:
    case.arrays["means"][:] = [0, 0, 4]
    case.arrays["log_scales"] -= 5
    case.arrays["opacity_logits"] -= 2


def _one_depth(case: Case) -> None:
    case.arrays["means"][:, 2] = 4


def _colours(case: Case) -> None:
    case.arrays["sh"] *= 10.0 ** case.between(0, 8, 1, 1)


def _cameras(case: Case) -> None:
    case.focal = 10.0 ** case.rng.uniform(-4, 5)
    x, y = case.rng.uniform(-3, 4, 2)
    case.centre = (x, y)


FAMILIES: dict[str, Callable[[Case], None]] = {
    "ordinary": lambda case: None,
    "NaN, infinity": _not_finite,
    "any value anywhere": _any_value,
    "quaternions of any length, zero": _quaternions,
    "scales 1e-3 to 1e2": _large_and_small,
    "scales 1e-12 to 1e12": _scales,
    "needles 1e6 : 1": _needles,
    "opacity logits of +-100": _opacities,
    "at the camera, the near plane": _near,
    "far off, behind": _beyond,
    "all in one pixel": _one_pixel,
    "all at one depth": _one_depth,
    "colours up to 1e8": _colours,
    "degenerate cameras": _cameras,
}


@dataclass
class Tally:
    """The results of a family. ``colour`` is the largest error of pixels off the cut-offs, relative
    to the image's largest value if that is above 1. ``gradients`` are the relative L2 errors of
    calls, all five parameters together, of Gaussians whose float64 gradient float32 can hold."""

    cases: int = 0
    drawn: int = 0
    dropped: int = 0
    not_finite: int = 0
    colour: float = 0.0
    gradients: list[float] = field(default_factory=list)

    def gradient(self, quantile: float) -> float:
        return float(np.quantile(self.gradients, quantile)) if self.gradients else 0.0

    def result(self, family: str) -> StressResult:
        return StressResult(
            family=family,
            cases=self.cases,
            drawn=self.drawn,
            dropped=self.dropped,
            not_finite=self.not_finite,
            colour=self.colour,
            gradient_median=self.gradient(0.5),
            gradient_p99=self.gradient(0.99),
            gradient_worst=self.gradient(1.0),
        )


def run(name: str, call: int, tally: Tally, backend: Backend) -> None:
    """Run one call: ``PER_CALL`` cases of a family, forward, backward and the reference."""
    rng = np.random.default_rng([list(FAMILIES).index(name), call])
    case = Case(rng)
    with np.errstate(all="ignore"):
        FAMILIES[name](case)
        scene = [torch.from_numpy(case.arrays[n].astype(np.float32)) for n in NAMES]
    width, height = case.size
    focal, (cx, cy) = case.focal * width, case.centre
    camera = RasterCamera(
        width, height, focal, focal, cx * width, cy * height, torch.eye(4, dtype=torch.float64)
    )
    options = RasterOptions(antialias=bool(rng.integers(2)), background=(0.1, 0.5, 0.9), threads=1)
    means, log_scales, quats, logits, sh = scene
    drawn = backend.forward(means, log_scales, quats, logits, sh, camera, options)
    d_color = torch.from_numpy(rng.standard_normal((height, width, 3)).astype(np.float32))

    leaves = [t.double().requires_grad_() for t in scene]
    projection = reference.project(*leaves, camera, options)  # type: ignore[call-arg, arg-type]
    colors = reference.sh_colors(
        leaves[0][projection.index], leaves[4][projection.index], camera, 3
    )
    image = reference.blend(projection, colors, camera, options)
    sure = image.margin > MARGIN
    d_color *= sure[..., None]
    found = backend.backward(drawn, d_color, colors=True, camera=True)

    values = [drawn.color, drawn.alpha, drawn.depth, drawn.median_depth, drawn.radii]
    values += [getattr(found, f.name) for f in fields(found) if f.name != "camera"]
    values += vars(found.camera).values()
    tally.not_finite += sum(int((~v.isfinite()).sum()) for v in values)
    tally.cases += PER_CALL
    tally.drawn += drawn.num_visible
    tally.dropped += drawn.num_dropped
    if not sure.any():
        return
    scale = max(1.0, float(image.color.detach().abs()[sure].max()))
    error = (drawn.color - image.color.detach()).abs()[sure].max()
    tally.colour = max(tally.colour, float(error) / scale)
    if not len(projection.index):
        return
    wanted = torch.autograd.grad((image.color * d_color).sum(), leaves)
    flat = torch.cat([w.reshape(PER_CALL, -1) for w in wanted], 1)
    ours = torch.cat([getattr(found, n).reshape(PER_CALL, -1) for n in NAMES], 1)
    held = (flat.abs() < LARGEST).all(1)  # false for NaN, too
    norm = float(flat[held].norm())
    if norm > 0:
        tally.gradients.append(float((ours[held] - flat[held]).norm()) / norm)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.raster_stress",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--cases", type=int, default=20_000, help="Gaussians over all families")
    parser.add_argument("--device", default="cpu", help="cpu, gpu or gpu:N")
    add_record_options(parser)
    args = parser.parse_args()
    backend = make_backend(args.device)
    torch.set_num_threads(1)
    calls = -(-args.cases // (PER_CALL * len(FAMILIES)))
    progress = Progress("stress", calls * len(FAMILIES), unit="calls")
    tallies = {name: Tally() for name in FAMILIES}
    for call in range(calls):
        for name, tally in tallies.items():
            run(name, call, tally, backend)
            progress.advance()
    print(
        f"{'':32} {'cases':>8} {'drawn':>8} {'dropped':>8} {'not finite':>10} {'colour':>9} "
        f"{'gradient':>9} {'99 %':>9} {'worst':>9}"
    )
    results = [tally.result(name) for name, tally in tallies.items()]
    for r in results:
        print(
            f"{r.family:32} {r.cases:8} {r.drawn:8} {r.dropped:8} {r.not_finite:10} "
            f"{r.colour:9.1e} {r.gradient_median:9.1e} {r.gradient_p99:9.1e} "
            f"{r.gradient_worst:9.1e}"
        )
    print(f"not finite in all: {sum(r.not_finite for r in results)}")
    if args.json:
        write_record(args.json, measured("raster_stress", args.note), results)


if __name__ == "__main__":
    main()
