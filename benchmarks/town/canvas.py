"""A picture of a face in metres, painted from back to front."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.town.finishes import Colour
from benchmarks.town.noise import fractal

Floats = NDArray[np.float32]


class Canvas:
    """Albedo of a face: linear RGB in (height, width, 3) texels, from the top left.

    Lengths are metres: x to the right from the left edge, z up from the lower edge.
    """

    def __init__(self, width: float, height: float, texel: float, seed: int) -> None:
        self.texel = texel
        self.width, self.height = width, height
        self.columns = max(2, round(width / texel))
        self.rows = max(2, round(height / texel))
        self.rng = np.random.default_rng(seed)
        self.pixels = np.zeros((self.rows, self.columns, 3), np.float32)

    def coordinates(self) -> tuple[Floats, Floats]:
        """x (1, columns) and z (rows, 1) of the texels' centres."""
        x = (np.arange(self.columns, dtype=np.float32) + 0.5) * self.texel
        z = self.height - (np.arange(self.rows, dtype=np.float32) + 0.5) * self.texel
        return x[None], z[:, None]

    def noise(self, finest: float, coarsest: float) -> Floats:
        """(rows, columns) noise of about zero mean and unit deviation, wavelengths in metres."""
        finest, coarsest = finest / self.texel, coarsest / self.texel
        return fractal(self.rng, self.rows, self.columns, max(1.0, finest), max(1.0, coarsest))

    def fill(self, colour: Colour, mottle: float = 0.0) -> None:
        """One colour, with small random changes of its tint."""
        self.pixels[:] = np.array(colour, np.float32)
        if mottle:
            self.scale(1 + mottle * self.noise(self.texel, 0.5))

    def scale(self, factor: Floats) -> None:
        """Multiply by (rows, columns) factors; never below a fifth."""
        self.pixels *= np.maximum(factor, np.float32(0.2))[..., None]

    def blend(self, share: Floats, colour: Colour) -> None:
        """Cover with a colour by (rows, columns) shares."""
        self.pixels += share[..., None] * (np.array(colour, np.float32) - self.pixels)

    def window(self, x0: float, z0: float, x1: float, z1: float) -> tuple[slice, slice]:
        """Texels of a rectangle, cropped to the canvas."""
        top, bottom = round((self.height - z1) / self.texel), round((self.height - z0) / self.texel)
        left, right = round(x0 / self.texel), round(x1 / self.texel)
        return (
            slice(max(0, top), max(0, min(bottom, self.rows))),
            slice(max(0, left), max(0, min(right, self.columns))),
        )

    def rectangle(
        self, x0: float, z0: float, x1: float, z1: float, colour: Colour, mottle: float = 0.06
    ) -> None:
        part = self.pixels[self.window(x0, z0, x1, z1)]
        grain = self.rng.standard_normal(part.shape[:2], dtype=np.float32)
        part[:] = np.array(colour, np.float32) * (1 + np.float32(mottle) * grain)[..., None]

    def shadow(self, x0: float, z0: float, x1: float, z1: float, factor: float) -> None:
        self.pixels[self.window(x0, z0, x1, z1)] *= np.float32(factor)

    def line(
        self, start: tuple[float, float], end: tuple[float, float], colour: Colour, width: float
    ) -> None:
        first, last = (
            (round(x / self.texel), round((self.height - z) / self.texel)) for x, z in (start, end)
        )
        cv2.line(self.pixels, first, last, colour, max(1, round(width / self.texel)))

    def disc(self, x: float, z: float, radius: float, colour: Colour) -> None:
        at = (round(x / self.texel), round((self.height - z) / self.texel))
        cv2.circle(self.pixels, at, round(radius / self.texel), colour, -1)

    def text(self, words: str, x: float, z: float, height: float, colour: Colour) -> None:
        """Letters with their lower left corner at (x, z)."""
        at = (round(x / self.texel), round((self.height - z) / self.texel))
        scale = height / self.texel / 21  # Hershey's capitals are 21 units high
        thickness = max(1, round(scale * 2.2))
        mask = np.zeros((self.rows, self.columns), np.uint8)
        cv2.putText(mask, words, at, cv2.FONT_HERSHEY_DUPLEX, scale, (255,), thickness, cv2.LINE_AA)
        self.blend(mask * np.float32(1 / 255), colour)
