"""The patches of a view that the other views contradict."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.training.transients.evidence import Comparison, Expected, Floats

Mask = NDArray[np.bool_]

#: A patch has a core with residuals above the first number, and above the second times what the
#: other views have on the surface; its other pixels have residuals above those of ``WEAK``.
STRONG, WEAK = (0.1, 4.0), (0.05, 2.5)
#: The other views' residual is taken to be at least this, the noise of photographs.
FLOOR = 0.01
#: The share of a pixel's weight that several views must show.
MIN_SUPPORT = 0.5
#: The smallest patch, and its smallest core, shares of a view.
MIN_PATCH, MIN_CORE = 4e-3, 1e-3
#: In and around a patch, render and photograph have at most this correlation: someone who passes by
#: has other edges than what is behind. The second number is for patches that were found before,
#: since training copies what they show into the scene.
MAX_CORRELATION, MAX_CORRELATION_AGAIN = 0.65, 0.75
#: A view with more in patches differs in light or pose: nothing in it is taken as transient.
MAX_SHARE = 0.4
#: A patch must have been found before in this share of its pixels.
MIN_AGREEMENT = 0.5
#: Pixels of the reduced images that patches are widened by: their borders have small residuals.
MARGIN = 2

_EIGHT = np.ones((3, 3), bool)


def has_core(residual: Floats) -> bool:
    """Whether residuals (H, W) are large enough for the core of a patch."""
    return int((residual > STRONG[0]).sum()) >= MIN_CORE * residual.size


def contradicted(view: Comparison, others: Expected, before: Mask) -> Mask:
    """(H, W) bool, the patches with a much larger residual than the other views have.

    Args:
        before: (H, W) bool, what the last search found.
    """
    residual = view.residual
    usual = np.maximum(others.residual, FLOOR)
    evidence = others.support > MIN_SUPPORT
    core, weak = (
        evidence & (residual > least) & (residual > ratio * usual)
        for least, ratio in (STRONG, WEAK)
    )
    labels, count = ndimage.label(weak, _EIGHT)
    sizes, cores = (
        np.bincount(labels[where], minlength=count + 1) for where in (weak, core & weak)
    )
    kept = (sizes >= MIN_PATCH * weak.size) & (cores >= MIN_CORE * weak.size)
    for label in np.flatnonzero(kept[1:]) + 1:
        patch = labels == label
        again = confirmed(patch, before).any()
        limit = MAX_CORRELATION_AGAIN if again else MAX_CORRELATION
        kept[label] = correlation(view, patch) < limit
    found = kept[labels] & weak
    return found if found.mean() <= MAX_SHARE else np.zeros_like(found)


def correlation(view: Comparison, patch: Mask) -> float:
    """The correlation of render and photograph in a patch and its margin: large if they differ in
    brightness alone, as in a reflection, or if edges are not sharp yet."""
    near = _with_margin(patch)
    rendered, photo = (image[near].astype(np.float64) for image in (view.rendered, view.photo))
    rendered, photo = rendered - rendered.mean(), photo - photo.mean()
    variances = float((rendered**2).sum() * (photo**2).sum())
    return float((rendered * photo).sum()) / math.sqrt(max(variances, 1e-12))


def confirmed(found: Mask, before: Mask) -> Mask:
    """The patches of ``found`` that were found ``before`` as well."""
    labels, count = ndimage.label(found, _EIGHT)
    sizes, again = (
        np.bincount(labels[where], minlength=count + 1) for where in (found, found & before)
    )
    return np.asarray((again >= MIN_AGREEMENT * np.maximum(sizes, 1))[labels] & found)


def widened(found: Mask) -> Mask:
    """The patches without holes, and a margin around them."""
    return _with_margin(ndimage.binary_fill_holes(found))


def _with_margin(found: Mask) -> Mask:
    return np.asarray(ndimage.binary_dilation(found, _EIGHT, iterations=MARGIN))
