"""Light that varies over the image: vignetting of cameras and slopes of photographs.

Both are measured from the colours of points at different places of images. With y the log2 display
value of point p in photograph i of camera k at position (x, y) (``scene.exposure.ViewLight``), the
model is y = c_p + g_i + v_k(r^2) + s_i . (x, y). As in Goldman and Chen (2005, *Vignette and
Exposure Calibration and Compensation*), v is a polynomial in r^2, of two terms. It is 0 at the
principal point and does not increase with r. The mean of the slopes is 0.

A part of the model is used if it predicts observations of points that it was not fitted to: see
``choose_parts``. Gains are kept as far as parts of the image agree on them: see ``trusted``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.photos.exposure import (
    GAMMA,
    MIN_OBSERVATIONS,
    Array,
    Indices,
    Observations,
    solve_gains,
)
from pipeline.scene.exposure import ViewLight

#: Vignetting and slopes are used if they lower the variance of held-out observations by this share
#: (a lens has two numbers for all photographs, each photograph two slopes) ...
MIN_VIGNETTING, MIN_SLOPES = 0.05, 0.1
#: ... and if it is visible: stops at half a diagonal from the principal point.
VISIBLE_STOPS = 0.1
#: Gains are used if at least this share of their squares remains of those that are ``trusted``.
MIN_TRUSTED = 0.5
#: Folds of the cross-validation, and the largest number of observations that it is done with.
FOLDS, MAX_EVIDENCE = 3, 60_000
#: Alternations between the parts of the model, and rounds of ``solve_gains`` in each.
ALTERNATIONS, GAIN_ROUNDS = 12, 2
#: The relaxation of the slopes in each alternation (successive over-relaxation).
RELAXATION = 1.5
#: Huber's bound in robust standard deviations, and its ratio to the median of absolute values.
HUBER, TO_DEVIATION = 1.5, 1.4826
#: Weights of the prior that there is no vignetting and no slope, squared half diagonals.
VIGNETTING_PRIOR, SLOPE_PRIOR = 0.5, 0.5
#: The darkest vignetting at the corner that is believed, log2 of display values.
MAX_VIGNETTING = 2.0
#: Photographs of a camera from which its vignetting, or its typical gain, can be known.
MIN_PHOTOGRAPHS = 4
#: Cells along half a diagonal: neighbouring observations have common errors.
CELLS = 3


@dataclass(frozen=True)
class Parts:
    """The parts of the model that vary over the image, and are used."""

    vignetting: bool = False
    slopes: bool = False


@dataclass(frozen=True)
class Light:
    """A fitted model, log2 of display values.

    Attributes:
        gains: (P, 3) of the photographs.
        vignetting: (C, 2) coefficients of r^2 and r^4 of the cameras.
        slopes: (P, 2) of the photographs, per half diagonal.
        measured: The number of photographs with a gain.
    """

    gains: Array
    vignetting: Array
    slopes: Array
    measured: int = 0

    def shading(self, seen: Observations) -> Array:
        """(M,) what vignetting and slopes add to each observation."""
        squared = np.square(seen.position).sum(axis=1)
        terms = self.vignetting[seen.camera]
        vignetting = squared * (terms[:, 0] + terms[:, 1] * squared)
        return vignetting + (self.slopes[seen.photo] * seen.position).sum(axis=1)

    def residual(self, seen: Observations) -> Array:
        """(M, 3) colours without the light, relative to their points' means."""
        plain = seen.y - self.gains[seen.photo] - self.shading(seen)[:, None]
        return plain - _means(seen.point, plain)[seen.point]

    @property
    def exposure_stops(self) -> float:
        """The standard deviation of the gains; the largest of the channels."""
        return float(self.gains.std(axis=0).max(initial=0.0) * GAMMA) if len(self.gains) else 0.0

    @property
    def vignetting_stops(self) -> float:
        """How much darker the corners are, for the camera with the strongest vignetting."""
        return float(-self.vignetting.sum(axis=1).min(initial=0.0) * GAMMA)

    @property
    def slope_stops(self) -> float:
        """The root mean square over the photographs of the change over half a diagonal."""
        if not len(self.slopes):
            return 0.0
        return float(np.sqrt(np.square(self.slopes).sum(axis=1).mean()) * GAMMA)

    def of_views(self, seen: Observations) -> list[ViewLight]:
        """The light of each view."""
        return [
            ViewLight(
                gain=tuple((2.0 ** self.gains[photo]).tolist()),
                vignetting=tuple(self.vignetting[camera].tolist()),
                slope=tuple(self.slopes[photo].tolist()),
            )
            for photo, camera in zip(seen.photo_of, seen.camera_of, strict=True)
        ]


def no_light(seen: Observations) -> Light:
    """The same light in all photographs."""
    photos, cameras = seen.num_photos, seen.num_cameras
    return Light(np.zeros((photos, 3)), np.zeros((cameras, 2)), np.zeros((photos, 2)))


def without_gains(light: Light) -> Light:
    """The light with all gains 1."""
    return replace(light, gains=np.zeros_like(light.gains))


def fit_light(seen: Observations, parts: Parts) -> Light:
    """Fit gains and the ``parts``, by alternation: gains are medians, the others weighted least
    squares with Huber's weights."""
    light = no_light(seen)
    if parts == Parts():
        found = solve_gains(seen.point, seen.photo, seen.y, seen.num_photos)
        return replace(light, gains=np.log2(found.gains), measured=found.measured)
    seen = seen.select(np.ones(len(seen.point), bool))
    for _ in range(ALTERNATIONS):
        plain = seen.y - light.shading(seen)[:, None]
        found = solve_gains(
            seen.point,
            seen.photo,
            plain,
            seen.num_photos,
            start=light.gains,
            rounds=GAIN_ROUNDS,
        )
        light = replace(light, gains=np.log2(found.gains), measured=found.measured)
        if parts.vignetting:
            light = replace(light, vignetting=_vignetting(seen, light))
        if parts.slopes:
            change = _slopes(seen, light) - light.slopes
            light = replace(light, slopes=light.slopes + RELAXATION * change)
    return light


def _vignetting(seen: Observations, light: Light) -> Array:
    """(C, 2) the cameras' vignetting, with the rest of ``light`` as it is.

    A camera is compared with itself alone: both the colours and the functions of r^2 are relative
    to their means over a point's observations by this camera.
    """
    slopes = (light.slopes[seen.photo] * seen.position).sum(axis=1)
    y = (seen.y - light.gains[seen.photo]).mean(axis=1) - slopes
    squared = np.square(seen.position).sum(axis=1)
    # Both functions decrease on 0 .. 1, and their sums with weights >= 0 are all that do.
    functions = -np.stack([squared - 0.5 * squared**2, squared**2], axis=1)
    _, group = np.unique(seen.point * seen.num_cameras + seen.camera, return_inverse=True)
    functions -= _means(group, functions)[group]
    y = y - _means(group, y[:, None])[group, 0]
    result = np.zeros((seen.num_cameras, 2))
    for camera in range(seen.num_cameras):
        rows = np.flatnonzero(seen.camera == camera)
        photographs = len(np.unique(seen.photo[rows]))
        if photographs < MIN_PHOTOGRAPHS or len(rows) < MIN_OBSERVATIONS * MIN_PHOTOGRAPHS:
            continue
        weights = np.zeros(2)
        for _ in range(3):
            error = y[rows] - functions[rows] @ weights
            trust = huber_weights(error)
            weights = _non_negative(functions[rows], y[rows], trust)
        weights *= min(1.0, MAX_VIGNETTING / max(0.5 * weights[0] + weights[1], 1e-12))
        result[camera] = -weights[0], 0.5 * weights[0] - weights[1]
    return result


def _non_negative(columns: Array, y: Array, trust: Array) -> Array:
    """(2,) weights >= 0 of two columns by weighted least squares with the prior of 0."""
    weighted = columns * trust[:, None]
    first, second = columns.T
    a = float((weighted[:, 0] * first).sum()) + VIGNETTING_PRIOR
    b = float((weighted[:, 0] * second).sum())
    d = float((weighted[:, 1] * second).sum()) + VIGNETTING_PRIOR
    p, q = float((weighted[:, 0] * y).sum()), float((weighted[:, 1] * y).sum())
    determinant = a * d - b * b
    found = np.array([(p * d - q * b) / determinant, (q * a - p * b) / determinant])
    if (found >= 0).all():
        return found
    # The optimum is on the border: one of the weights, or both, are 0.
    one, other = max(p / a, 0.0), max(q / d, 0.0)
    return np.array([one, 0.0]) if one * p >= other * q else np.array([0.0, other])


def _slopes(seen: Observations, light: Light) -> Array:
    """(P, 2) the slopes of the photographs, with the rest of ``light`` as it is."""
    error = light.residual(seen).mean(axis=1)
    error += (light.slopes[seen.photo] * seen.position).sum(axis=1)
    trust = huber_weights(error)
    count, photo = seen.num_photos, seen.photo

    def total(values: Array) -> Array:
        return np.bincount(photo, trust * values, count).astype(np.float64)

    weight = np.maximum(total(np.ones(len(photo))), 1e-12)
    centred = [column - (total(column) / weight)[photo] for column in (*seen.position.T, error)]
    x, y, e = centred
    a, b, d = total(x * x) + SLOPE_PRIOR, total(x * y), total(y * y) + SLOPE_PRIOR
    p, q = total(x * e), total(y * e)
    slopes = np.stack([p * d - q * b, q * a - p * b], axis=1) / (a * d - b * b)[:, None]
    measured = np.bincount(photo, minlength=count) >= MIN_OBSERVATIONS
    if measured.any():
        # The shading of the scene, such as a bright floor, makes slopes that are alike.
        slopes -= slopes[measured].mean(axis=0)
    slopes[~measured] = 0.0
    return slopes


def huber_weights(error: Array) -> Array:
    """Huber's weights of residuals (M,): 1 up to ``HUBER`` robust standard deviations."""
    deviation = TO_DEVIATION * float(np.median(np.abs(error))) if len(error) else 0.0
    return np.minimum(1.0, HUBER * deviation / np.maximum(np.abs(error), 1e-12))


def choose_parts(seen: Observations) -> Parts:
    """The parts that predict observations of points that they were not fitted to, in this order:
    vignetting, slopes. A part that would not be visible is not examined."""
    parts = Parts()
    if seen.in_parts:
        return parts
    seen = _evidence(seen)
    if not len(seen.point):
        return parts
    for part, visible, share in (
        ("vignetting", "vignetting_stops", MIN_VIGNETTING),
        ("slopes", "slope_stops", MIN_SLOPES),
    ):
        more = replace(parts, **{part: True})
        if getattr(fit_light(seen, more), visible) < VISIBLE_STOPS:
            continue
        if _held_out(seen, parts, more) < 1 - share:
            parts = more
    return parts


def _evidence(seen: Observations) -> Observations:
    """At most about ``MAX_EVIDENCE`` observations: of every so many points all."""
    step = -(-len(seen.point) // MAX_EVIDENCE)
    return seen.select(seen.point % max(step, 1) == 0)


def _held_out(seen: Observations, less: Parts, more: Parts) -> float:
    """The ratio of the variances of observations of held-out points with ``more`` and ``less``
    parts, of colours relative to their points' means."""
    errors = np.zeros(2)
    for fold in range(FOLDS):
        held_out = seen.point % FOLDS == fold
        rest, tested = seen.select(~held_out), seen.select(held_out)
        errors += robust_variances(
            [fit_light(rest, parts).residual(tested) for parts in (less, more)]
        )
    return float(errors[1] / errors[0]) if errors[0] > 0 else 1.0


def robust_variances(residuals: list[Array]) -> Array:
    """The mean squares of residuals (M, 3), each limited to Huber's bound of the first ones."""
    if not residuals[0].size:
        return np.zeros(len(residuals))
    bound = 2 * HUBER * TO_DEVIATION * float(np.median(np.abs(residuals[0])))
    return np.array([np.square(r.clip(-bound, bound)).sum() for r in residuals])


def trusted(seen: Observations, light: Light) -> Light:
    """The light with each gain as far as its photograph is evidence of it.

    With u the uncertainty of a gain and d its distance to the typical one, 1 - (u / d)^2 of the
    distance remains (the positive part of the estimator of James and Stein 1961). u is the larger
    one of the standard error, from cells of the image, and of the disagreement between halves of
    the image. The typical gain is the median over the photographs of the camera.
    """
    seen = seen.select(np.ones(len(seen.point), bool))
    shown = light.residual(seen)
    typical = _typical_gains(seen, light)
    gains = typical.copy()
    order = np.argsort(seen.photo, kind="stable")
    ends = np.cumsum(np.bincount(seen.photo, minlength=seen.num_photos))[:-1]
    for photo, rows in enumerate(np.split(order, ends)):
        if len(rows) < MIN_OBSERVATIONS:
            continue
        distance = light.gains[photo] - typical[photo]
        size = float(np.linalg.norm(distance))
        uncertainty = _uncertainty(shown[rows], seen.position[rows], seen.view[rows], seen.in_parts)
        if size > uncertainty:
            gains[photo] += distance * (1 - (uncertainty / size) ** 2)
    return replace(light, gains=gains)


def is_trusted(seen: Observations, light: Light) -> bool:
    """Whether photographs are evidence of their gains, in total: see ``MIN_TRUSTED``."""
    kept = np.square(trusted(seen, light).gains).sum()
    return bool(kept >= MIN_TRUSTED * np.square(light.gains).sum() > 0)


def _typical_gains(seen: Observations, light: Light) -> Array:
    """(P, 3) the median gain of each photograph's camera; 0 for one with few photographs."""
    count = np.bincount(seen.photo, minlength=seen.num_photos)
    camera = np.zeros(seen.num_photos, np.int64)
    camera[seen.photo_of] = seen.camera_of
    result: Array = np.zeros((seen.num_photos, 3))
    for body in range(seen.num_cameras):
        known = (camera == body) & (count >= MIN_OBSERVATIONS)
        if known.sum() >= MIN_PHOTOGRAPHS:
            result[camera == body] = np.median(light.gains[known], axis=0)
    return result


def _uncertainty(residual: Array, position: Array, view: Indices, in_parts: bool) -> float:
    """The uncertainty of a photograph's gain from residuals (M, 3): see ``trusted``."""
    column, row = np.floor(position * CELLS).astype(np.int64).clip(-50, 50).T
    if in_parts:
        column, row = np.zeros_like(column), np.zeros_like(row)
    _, cell = np.unique((view * 128 + row + 64) * 128 + column + 64, return_inverse=True)
    cells = _means(cell, residual.clip(-1, 1))
    many = np.bincount(cell)
    weight = (many / many.sum())[:, None]
    centre = (weight * cells).sum(axis=0)
    # The variance of a mean of cells with unequal weights.
    variance = (weight**2 * np.square(cells - centre)).sum(axis=0)
    effective = 1 / float((weight**2).sum())
    error = float(np.sqrt(variance.sum() * effective / max(effective - 1, 1e-3)))
    if in_parts:
        return error
    halves = [_disagreement(residual, position[:, axis] < 0) for axis in (0, 1)]
    return max(error, *halves)


def _disagreement(residual: Array, first: NDArray[np.bool_]) -> float:
    """Half the distance of the medians of two parts; 0 if one of them has too few residuals."""
    parts = residual[first], residual[~first]
    if min(map(len, parts)) < MIN_OBSERVATIONS // 2:
        return 0.0
    one, other = (np.median(part, axis=0) for part in parts)
    return float(np.linalg.norm(one - other)) / 2


def _means(group: Indices, values: Array) -> Array:
    """(G, K) the means of values (M, K) over groups."""
    count = np.maximum(np.bincount(group), 1)
    sums = [np.bincount(group, column) for column in values.T]
    result: Array = np.stack(sums, axis=1) / count[:, None]
    return result
