"""The appearance of a trained scene in a photograph, which may not be a training photograph."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.render import Backend, RasterOptions, make_backend
from pipeline.render.views import limit_sh_degree, raster_camera
from pipeline.scene.appearance import Appearance, fitted_columns
from pipeline.scene.exposure import ViewLight
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.training.appearance.embedding import with_appearance

Array = NDArray[np.float64]

# Gauss-Newton steps. Only colours that are clamped at 0 make the problem nonlinear.
STEPS = 4
# Difference of an embedding at which a render is linearised, in standard deviations.
DIFFERENCE = 0.1
# The smallest one: renders have single precision.
MIN_DIFFERENCE = 1e-3
# The prior has the deviations of the training photographs' embeddings; one deviation costs as much
# as this sum of squared errors. It matters only where the fitted pixels hardly depend on a number
# of the embedding.
PRIOR = 1.0


def in_photograph(
    gaussians: Gaussians,
    appearance: Appearance,
    view: View,
    photo: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None,
    options: RasterOptions,
    light: ViewLight | None = None,
    backend: Backend | None = None,
) -> Gaussians:
    """The Gaussians in the colours of a photograph. The embedding of a photograph that is not a
    training photograph is fitted on its left half.

    Args:
        gaussians: The Gaussians of the scene.
        photo: (H, W, 3) colours over the background of ``options``.
        mask: (H, W), False for ignored pixels; None if there are none.
        light: By which a render is multiplied before it is compared; None for nothing.
    """
    gaussians = replace(gaussians, appearance=torch.from_numpy(appearance.colors))
    embedding, gain = appearance.embeddings.get(view.name), appearance.gains.get(view.name)
    if embedding is None:
        left = np.zeros(photo.shape[:2], bool)
        left[:, : fitted_columns(photo.shape[1])] = True
        pixels = left if mask is None else left & mask
        factor = None if light is None else light.factor(view)
        target = Target(view, photo, pixels, factor)
        embedding, gain = fit_appearance(gaussians, appearance, target, options, backend)
    return replace(with_appearance(gaussians, embedding, gain), appearance=None)


@dataclass(frozen=True)
class Target:
    """What a render shall look like.

    Attributes:
        photo: (H, W, 3) colours over the background.
        pixels: (H, W) bool, True for the pixels to fit.
        factor: (3,) or (H, W, 3), by which the render is multiplied; None for 1.
    """

    view: View
    photo: NDArray[np.uint8]
    pixels: NDArray[np.bool_]
    factor: NDArray[np.float32] | None = None


def fit_appearance(
    gaussians: Gaussians,
    appearance: Appearance,
    target: Target,
    options: RasterOptions,
    backend: Backend | None = None,
) -> tuple[Array, Array | None]:
    """The embedding (K,) and the gain (3,) with which the render is closest to some pixels of a
    photograph, by least squares. The gain is None if the training photographs have none.

    Args:
        gaussians: The Gaussians with ``appearance``.
        backend: The backend of the rasterizer; None: the default.
    """
    backend = backend or make_backend()
    options = limit_sh_degree(options, gaussians)
    camera, pixels = raster_camera(target.view), target.pixels
    wanted, factor = target.photo[pixels] / 255.0, target.factor
    known = np.array(list(appearance.embeddings.values()))
    size = known.shape[1]
    # The unknowns are the embedding, and the logarithms of the gain.
    deviations = np.sqrt((known**2).mean(0))
    if appearance.gains:
        logarithms = np.log(np.array(list(appearance.gains.values())))
        deviations = np.concatenate([deviations, np.sqrt((logarithms**2).mean(0))])
    deviations = deviations + 1e-6
    prior = PRIOR / deviations**2

    def gain_of(unknowns: Array) -> Array | None:
        return np.exp(unknowns[size:]) if len(unknowns) > size else None

    def render(unknowns: Array) -> Array:
        shown = with_appearance(gaussians, unknowns[:size], gain_of(unknowns))
        color = backend.forward(*shown.parameters(), camera, options).color.numpy()
        shaded = color if factor is None else color * factor
        return shaded[pixels].astype(np.float64)

    unknowns = np.zeros(len(deviations))
    for _ in range(STEPS):
        now = render(unknowns)
        slopes = [
            (render(unknowns + step) - now) / step.sum()
            for step in np.diag(np.maximum(DIFFERENCE * deviations, MIN_DIFFERENCE))
        ]
        # Avoid matrix products: BLAS may round differently with the number of threads.
        normal = np.array([[np.sum(a * b) for b in slopes] for a in slopes])
        right = np.array([np.sum(a * (wanted - now)) for a in slopes])
        unknowns = unknowns + np.linalg.solve(normal + np.diag(prior), right - prior * unknowns)
    return unknowns[:size], gain_of(unknowns)
