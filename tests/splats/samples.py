"""Random Gaussians with typical parameters, and comparison with tolerances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.splats.gaussians import Gaussians


def sample(count: int = 40, degree: int = 3, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    bands = (degree + 1) ** 2
    sh = np.concatenate(
        [rng.uniform(-1.7, 1.7, (count, 1, 3)), rng.normal(0, 0.15, (count, bands - 1, 3))], axis=1
    )
    return Gaussians.from_arrays(
        {
            "means": rng.normal(0, 2, (count, 3)),
            "log_scales": rng.uniform(-8, 1, (count, 3)),
            "quats": rng.normal(0, 1, (count, 4)),
            "opacity_logits": rng.uniform(-5, 7, count),
            "sh": sh.clip(-1.7, 1.7),
        }
    )


@dataclass(frozen=True)
class Within:
    """Tolerances: position, log scale, opacity, rotation in degrees, constant and higher SH
    coefficients."""

    position: float
    log_scale: float
    opacity: float
    degrees: float
    dc: float
    higher: float

    def check(self, found: Gaussians, expected: Gaussians) -> None:
        assert len(found) == len(expected) and found.sh_degree == expected.sh_degree
        a, b = found.arrays(), expected.arrays()
        for array in a.values():
            assert array.dtype == np.float32 and array.flags.c_contiguous

        def largest(values: np.ndarray) -> float:
            return float(np.abs(values).max(initial=0.0))

        assert largest(a["means"] - b["means"]) <= self.position
        assert largest(a["log_scales"] - b["log_scales"]) <= self.log_scale
        assert largest(opacity(found) - opacity(expected)) <= self.opacity
        assert largest(rotation_angle(found, expected)) <= self.degrees
        assert largest(a["sh"][:, 0] - b["sh"][:, 0]) <= self.dc
        assert largest(a["sh"][:, 1:] - b["sh"][:, 1:]) <= self.higher


#: Equal up to float32 rounding.
EXACT = Within(1e-6, 1e-6, 1e-6, 0.05, 1e-6, 1e-6)


def opacity(gaussians: Gaussians) -> np.ndarray:
    return 1 / (1 + np.exp(-np.float64(gaussians.arrays()["opacity_logits"])))


def rotation_angle(a: Gaussians, b: Gaussians) -> np.ndarray:
    """(N,) degrees between the ellipsoids' axes, which have no direction: quaternions that differ
    in sign or by half a turn about one of the axes are equal."""
    p, q = (np.float64(g.arrays()["quats"]) for g in (a, b))
    p, q = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (p, q))
    w, x, y, z = q.T
    turned = [(w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)]
    same = np.stack([sign * np.stack(values, 1) for values in turned for sign in (1, -1)])
    # The chord is exact for small angles, where the arc cosine is not.
    chord = np.linalg.norm(p - same, axis=2).min(0)
    return np.degrees(4 * np.arcsin(np.clip(chord / 2, 0, 1)))
