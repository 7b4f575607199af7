"""Paints roofs and the smaller things: hedges, fences, cars, trunks."""

from __future__ import annotations

import numpy as np

from benchmarks.town.canvas import Canvas
from benchmarks.town.finishes import Colour, Finish
from benchmarks.town.walls import paint_wall

TEXEL = 0.02
ROOF_TEXEL = 0.025
MOSS: Colour = (0.10, 0.14, 0.05)


def painted(finish: Finish, width: float, height: float) -> Canvas:
    """The texture of a face of ``width`` times ``height`` metres."""
    roof = finish.kind in ("tiles", "slates", "gravel")
    canvas = Canvas(width, height, ROOF_TEXEL if roof else TEXEL, finish.seed)
    _PAINTERS.get(finish.kind, paint_wall)(canvas, finish)
    return canvas


def _tiles(canvas: Canvas, finish: Finish) -> None:
    size = (0.24, 0.32) if finish.kind == "tiles" else (0.3, 0.22)
    x, z = canvas.coordinates()
    row = np.floor(z / size[1]).astype(np.intp)
    along = x / size[0] + (0.5 * (row % 2) if finish.kind == "slates" else 0.0)
    column = np.floor(along).astype(np.intp)
    tints = canvas.rng.normal(0, 1, (row.max() + 1, column.max() + 2)).astype(np.float32)
    canvas.fill(finish.colour)
    canvas.scale(1 + 0.17 * tints[row, column] + 0.05 * canvas.noise(0.025, 0.3))
    within = z / size[1] - row
    canvas.scale(np.clip(0.55 + 3 * within, 0.55, 1) * np.clip(0.7 + 2 * (along - column), 0.7, 1))
    canvas.scale(1 + 0.1 * canvas.noise(0.5, 4.0))
    moss = canvas.noise(0.1, 1.6) - canvas.rng.uniform(0.9, 1.8)
    canvas.blend(np.clip(moss, 0, 0.8).astype(np.float32), MOSS)
    rng = canvas.rng
    for _ in range(rng.integers(0, 3)):
        a, b = rng.uniform(0.5, max(0.6, canvas.width - 1.5)), rng.uniform(0.6, canvas.height - 1)
        canvas.rectangle(a - 0.07, b - 0.07, a + 0.85, b + 1.07, (0.15, 0.15, 0.15))
        canvas.rectangle(a, b, a + 0.78, b + 1.0, (0.12, 0.18, 0.25), 0.1)
    if rng.random() < 0.2 and canvas.width > 6:
        _panels(canvas)
    canvas.line((0, canvas.height), (canvas.width, canvas.height), (0.2, 0.16, 0.14), 0.2)
    canvas.line((0, 0.03), (canvas.width, 0.03), (0.2, 0.2, 0.2), 0.08)


def _panels(canvas: Canvas) -> None:
    left, low = canvas.rng.uniform(0.5, canvas.width - 5), 0.8
    for i in range(int(canvas.rng.integers(2, 5))):
        x = left + i * 1.05
        canvas.rectangle(x, low, x + 1.0, min(low + 1.7, canvas.height - 0.3), (0.03, 0.04, 0.1))
        for z in np.arange(low + 0.17, low + 1.7, 0.17):
            canvas.line((x, z), (x + 1.0, z), (0.12, 0.14, 0.2), 0.02)


def _gravel(canvas: Canvas, finish: Finish) -> None:
    canvas.fill(finish.colour)
    canvas.scale(1 + 0.16 * canvas.noise(0.025, 0.1) + 0.13 * canvas.noise(0.3, 3.0))
    rng = canvas.rng
    for _ in range(int(canvas.width * canvas.height / 12)):
        x, z = rng.uniform(0.5, canvas.width), rng.uniform(0.5, canvas.height)
        grey = rng.uniform(0.08, 0.5)
        a, b = rng.uniform(0.2, 0.9, 2)
        canvas.shadow(x + 0.1, z - 0.15, x + a + 0.15, z + b - 0.1, 0.5)
        canvas.rectangle(x, z, x + a, z + b, (grey, grey, grey))
    for z in np.arange(1.0, canvas.height, 1.0):
        canvas.line((0, z), (canvas.width, z), (0.12, 0.12, 0.13), 0.03)


def _wood(canvas: Canvas, finish: Finish) -> None:
    canvas.fill(finish.colour)
    canvas.scale(1 + 0.12 * canvas.noise(0.02, 0.3))


def _hedge(canvas: Canvas, finish: Finish) -> None:
    canvas.fill(finish.colour)
    leaf = canvas.noise(0.04, 0.35)
    canvas.scale(0.85 + 0.42 * leaf)
    canvas.blend(np.clip(canvas.noise(0.06, 0.5) - 1.2, 0, 0.7), (0.3, 0.34, 0.1))
    z = canvas.coordinates()[1]
    canvas.scale(np.clip(0.6 + z, 0.6, 1) + np.zeros_like(leaf))


def _fence(canvas: Canvas, finish: Finish) -> None:
    x = canvas.coordinates()[0]
    plank = np.floor(x / 0.14).astype(np.intp)
    tint = canvas.rng.normal(0, 0.16, plank.max() + 1).astype(np.float32)[plank]
    gap = np.clip(1.2 - (x / 0.14 - plank) / 0.12, 0, 1)
    grain = canvas.noise(0.02, 0.3)
    canvas.fill(finish.colour)
    canvas.scale(1 + tint + 0.12 * grain - 0.7 * gap)
    for z in (0.25, canvas.height - 0.25):
        canvas.shadow(0, z, canvas.width, z + 0.08, 0.75)


def _bark(canvas: Canvas, finish: Finish) -> None:
    canvas.fill(finish.colour)
    canvas.scale(1 + 0.35 * canvas.noise(0.03, 0.15))


def _car(canvas: Canvas, finish: Finish) -> None:
    """Sides, from the ground clearance up; wheels and doors on the long ones."""
    canvas.fill(finish.colour)
    canvas.scale(1 + 0.03 * canvas.noise(0.02, 0.4) + 0.06 * canvas.noise(0.3, 2.0))
    if canvas.width > 3 and canvas.height > 0.3:
        for x in (0.21 * canvas.width, 0.79 * canvas.width):
            canvas.disc(x, 0.06, 0.34, (0.02, 0.02, 0.02))
            canvas.disc(x, 0.06, 0.2, (0.35, 0.35, 0.37))
        for x in (0.36, 0.55, 0.72):
            x *= canvas.width
            canvas.line((x, 0.1), (x, canvas.height), (0.03, 0.03, 0.03), 0.02)
        canvas.rectangle(0.1, canvas.height - 0.25, 0.35, canvas.height - 0.1, (0.6, 0.1, 0.05))
    elif canvas.height > 0.3:
        for x in (0.12, canvas.width - 0.42):
            canvas.rectangle(x, 0.38, x + 0.3, 0.55, (0.7, 0.7, 0.65))
        canvas.rectangle(canvas.width / 2 - 0.26, 0.12, canvas.width / 2 + 0.26, 0.24, (0.7,) * 3)
        plate = "".join(canvas.rng.choice(list("ABEHKLMST0123456789"), 5))
        canvas.text(plate, canvas.width / 2 - 0.22, 0.14, 0.09, (0.05, 0.05, 0.05))


def _cabin(canvas: Canvas, finish: Finish) -> None:
    _car(canvas, finish)
    rng = canvas.rng
    x, step = 0.14, max(0.5, canvas.width / 3)
    while x < canvas.width - 0.2:
        right = min(x + step - 0.08, canvas.width - 0.14)
        tone = rng.uniform(0.02, 0.1)
        canvas.rectangle(x, 0.06, right, canvas.height - 0.08, (tone, tone * 1.1, tone * 1.3), 0.15)
        x += step


def _sign(canvas: Canvas, finish: Finish) -> None:
    canvas.fill(finish.accent)
    canvas.rectangle(0.04, 0.04, canvas.width - 0.04, canvas.height - 0.04, finish.colour)
    for z in np.arange(0.12, canvas.height - 0.1, 0.12):
        letters = "".join(canvas.rng.choice(list("AEIORSTNLM"), 9))
        canvas.text(letters, 0.08, z, 0.08, finish.accent)


_PAINTERS = {
    "tiles": _tiles,
    "slates": _tiles,
    "gravel": _gravel,
    "wood": _wood,
    "metal": _wood,
    "hedge": _hedge,
    "fence": _fence,
    "bark": _bark,
    "car": _car,
    "cabin": _cabin,
    "sign": _sign,
}
