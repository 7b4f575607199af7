"""Paints the walls of houses: material, windows, doors, shops and what time adds to them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from benchmarks.town.canvas import Canvas
from benchmarks.town.finishes import Colour, Finish

STOREY = 2.8
SILL = 0.9
WINDOW_PITCH = 2.3
DOOR = (1.05, 2.15)
FRAMES: tuple[Colour, ...] = ((0.75, 0.74, 0.70), (0.30, 0.17, 0.09), (0.12, 0.20, 0.15))
FLOWERS: tuple[Colour, ...] = ((0.6, 0.06, 0.1), (0.7, 0.3, 0.04), (0.5, 0.1, 0.45))
SHOPS = ("BAKERY", "CAFE", "BOOKS", "FLOWERS", "TAILOR", "WINE", "CYCLES", "CHEMIST", "SHOES")
BEAM: Colour = (0.09, 0.055, 0.035)


def paint_wall(canvas: Canvas, finish: Finish) -> None:
    """A wall that stands on the ground; its lower edge is the canvas's."""
    _MATERIALS[finish.kind](canvas, finish.colour)
    _weather(canvas)
    if finish.eaves <= 0:
        return
    _plinth(canvas)
    rng = canvas.rng
    frame = FRAMES[rng.integers(len(FRAMES))]
    size = (rng.uniform(0.95, 1.3), rng.uniform(1.15, 1.5))
    shutters = finish.accent if rng.random() < 0.45 else None
    columns = max(1, int((canvas.width - 0.9) / WINDOW_PITCH))
    pitch = (canvas.width - 0.6) / columns
    door = int(rng.integers(columns)) if finish.door else -1
    storeys = max(1, int((finish.eaves + 0.3) / STOREY))
    for storey in range(storeys):
        if storey == 0 and finish.shop:
            _shop(canvas, finish)
            continue
        for column in range(columns):
            x = 0.3 + (column + 0.5) * pitch + rng.uniform(-0.15, 0.15)
            if storey == 0 and column == door:
                _door(canvas, x, finish)
            elif rng.random() < 0.88:
                _window(canvas, x, storey * STOREY + SILL, size, frame, shutters)
    if canvas.height > finish.eaves + 1.9:
        _window(canvas, canvas.width / 2, finish.eaves + 0.35, (0.8, 0.9), frame, None)
    _additions(canvas, finish)


def _plaster(canvas: Canvas, colour: Colour) -> None:
    canvas.fill(colour)
    canvas.scale(1 + 0.07 * canvas.noise(0.02, 0.3) + 0.08 * canvas.noise(0.3, 3.0))


def _brick(canvas: Canvas, colour: Colour) -> None:
    x, z = canvas.coordinates()
    row = np.floor(z / 0.08).astype(np.intp)
    along = x / 0.26 + 0.5 * (row % 2)
    column = np.floor(along).astype(np.intp)
    tints = canvas.rng.normal(0, 1, (row.max() + 1, column.max() + 2, 2)).astype(np.float32)
    tint = tints[row, column]
    joint = np.minimum(z / 0.08 - row, (along - column) * 3.2)
    mortar = np.clip(1.3 - joint / 0.2, 0, 1).astype(np.float32)
    canvas.fill(colour)
    canvas.scale(1 + 0.2 * tint[..., 0] + 0.06 * canvas.noise(0.02, 0.2))
    canvas.pixels[..., 0] *= 1 + 0.1 * np.clip(tint[..., 1], -2, 2)
    canvas.blend(0.8 * mortar, (0.42, 0.40, 0.36))


def _boards(canvas: Canvas, colour: Colour) -> None:
    z = canvas.coordinates()[1]
    row = np.floor(z / 0.16).astype(np.intp)
    tint = canvas.rng.normal(0, 0.07, row.max() + 1).astype(np.float32)[row]
    groove = np.clip(1 - (z / 0.16 - row) / 0.15, 0, 1)
    canvas.fill(colour)
    canvas.scale(1 + tint + 0.08 * canvas.noise(0.02, 0.16) - 0.45 * groove)
    for _ in range(int(canvas.width * canvas.height / 2)):
        x, board = canvas.rng.uniform(0, canvas.width), canvas.rng.integers(row.max() + 1)
        canvas.line((x, board * 0.16), (x, board * 0.16 + 0.15), (0.05, 0.05, 0.05), 0.02)


def _timber(canvas: Canvas, colour: Colour) -> None:
    _plaster(canvas, colour)
    rng, x = canvas.rng, 0.1
    beams = [0.1]
    while x < canvas.width - 0.8:
        x += rng.uniform(0.8, 1.5)
        beams.append(min(x, canvas.width - 0.1))
    levels = np.append(np.arange(0.5, canvas.height, STOREY / 2), canvas.height)
    for z in levels:
        canvas.line((0, z), (canvas.width, z), BEAM, 0.18)
    for left, right in zip(beams, [*beams[1:], canvas.width], strict=True):
        canvas.line((left, 0), (left, canvas.height), BEAM, 0.17)
        for low, high in pairwise(levels):
            if rng.random() < 0.35:
                ends = (low, high) if rng.random() < 0.5 else (high, low)
                canvas.line((left, ends[0]), (right, ends[1]), BEAM, 0.14)


def _stone(canvas: Canvas, colour: Colour) -> None:
    canvas.fill(colour)
    canvas.scale(1 + 0.1 * canvas.noise(0.02, 0.2))
    rng, z = canvas.rng, 0.0
    while z < canvas.height:
        height = rng.uniform(0.18, 0.34)
        x = -rng.uniform(0, 0.3)
        while x < canvas.width:
            width = rng.uniform(0.22, 0.7)
            part = canvas.pixels[canvas.window(x, z, x + width, z + height)]
            part *= np.float32(rng.uniform(0.65, 1.25))
            canvas.line((x, z), (x, z + height), (0.3, 0.28, 0.25), 0.02)
            x += width
        canvas.line((0, z), (canvas.width, z), (0.3, 0.28, 0.25), 0.02)
        z += height


_MATERIALS = {
    "plaster": _plaster,
    "brick": _brick,
    "boards": _boards,
    "timber": _timber,
    "stone": _stone,
}


def _weather(canvas: Canvas) -> None:
    """Stains from above, dirt and less light near the ground."""
    z = canvas.coordinates()[1]
    stains = canvas.noise(0.1, 2.0)
    canvas.scale(1 - 0.12 * np.clip(stains - 0.4, 0, 2))
    canvas.scale(np.clip(0.72 + 0.28 * z / 0.6, 0, 1) + np.zeros_like(stains))


def _plinth(canvas: Canvas) -> None:
    height = canvas.rng.uniform(0.35, 0.65)
    part = canvas.pixels[canvas.window(0, 0, canvas.width, height)]
    part *= np.float32(0.4)
    part += (
        np.float32(0.06) + 0.015 * canvas.rng.standard_normal(part.shape[:2], np.float32)[..., None]
    )
    canvas.line((0, height), (canvas.width, height), (0.12, 0.12, 0.12), 0.03)


def _window(
    canvas: Canvas,
    x: float,
    sill: float,
    size: tuple[float, float],
    frame: Colour,
    shutters: Colour | None,
) -> None:
    half, height = size[0] / 2, size[1]
    left, right, top = x - half, x + half, sill + height
    canvas.shadow(left - 0.06, sill - 0.12, right + 0.1, top + 0.06, 0.62)
    canvas.rectangle(left - 0.04, sill - 0.04, right + 0.04, top + 0.04, frame)
    for pane in range(2):
        a = left + 0.05 + pane * (half - 0.02)
        _glass(canvas, a, sill + 0.05, a + half - 0.08, top - 0.05)
    if height > 1.25:
        canvas.rectangle(left, sill + 0.62 * height, right, sill + 0.62 * height + 0.05, frame)
    canvas.rectangle(left - 0.12, sill - 0.1, right + 0.12, sill - 0.03, (0.5, 0.48, 0.45))
    if shutters is not None:
        for a in (left - 0.06 - half, right + 0.06):
            canvas.rectangle(a, sill - 0.03, a + half, top + 0.03, shutters, 0.1)
            for z in np.arange(sill + 0.06, top, 0.09):
                canvas.shadow(a + 0.06, z, a + half - 0.06, z + 0.03, 0.6)
    if canvas.rng.random() < 0.25:
        _flowers(canvas, left, right, sill - 0.06)


def _glass(canvas: Canvas, x0: float, z0: float, x1: float, z1: float) -> None:
    """Dark glass, brighter above, behind it curtains."""
    rows, columns = canvas.window(x0, z0, x1, z1)
    part = canvas.pixels[rows, columns]
    if part.size == 0:
        return
    fade = np.linspace(canvas.rng.uniform(0.12, 0.3), 0.03, part.shape[0], dtype=np.float32)
    part[:] = fade[:, None, None] * np.array([0.75, 0.9, 1.1], np.float32)
    if canvas.rng.random() < 0.6:
        share = canvas.rng.uniform(0.2, 0.9)
        cloth = part[:, : int(share * part.shape[1])]
        if canvas.rng.random() < 0.5:
            cloth = part[: int(share * part.shape[0])]
        folds = np.asarray(canvas.rng.uniform(0.25, 0.6, cloth.shape[1]), np.float32)
        cloth[:] = folds[None, :, None] * canvas.rng.uniform(0.6, 1.0, 3).astype(np.float32)


def _flowers(canvas: Canvas, left: float, right: float, z: float) -> None:
    canvas.rectangle(left, z, right, z + 0.16, (0.18, 0.09, 0.05))
    colour = FLOWERS[canvas.rng.integers(len(FLOWERS))]
    for _ in range(int(40 * (right - left))):
        at = canvas.rng.uniform(left, right), z + canvas.rng.uniform(0.1, 0.34)
        canvas.disc(*at, 0.03, colour if canvas.rng.random() < 0.5 else (0.05, 0.14, 0.03))


def _door(canvas: Canvas, x: float, finish: Finish) -> None:
    half, height = DOOR[0] / 2, DOOR[1]
    base = 0.25
    canvas.rectangle(x - half - 0.25, 0, x + half + 0.25, base, (0.38, 0.37, 0.35))
    canvas.rectangle(x - half - 0.1, base, x + half + 0.1, base + height + 0.1, (0.55, 0.53, 0.5))
    canvas.rectangle(x - half, base, x + half, base + height, finish.accent)
    for row in range(int(canvas.rng.integers(2, 5))):
        z = base + 0.15 + row * 0.48
        canvas.shadow(x - half + 0.12, z, x - 0.06, z + 0.36, 0.6)
        canvas.shadow(x + 0.06, z, x + half - 0.12, z + 0.36, 0.6)
    canvas.disc(x + half - 0.1, base + 1.0, 0.04, (0.6, 0.5, 0.2))
    number = str(canvas.rng.integers(1, 99))
    canvas.rectangle(x + half + 0.2, base + 1.5, x + half + 0.62, base + 1.8, (0.05, 0.09, 0.25))
    canvas.text(number, x + half + 0.24, base + 1.56, 0.18, (0.8, 0.8, 0.8))


def _shop(canvas: Canvas, finish: Finish) -> None:
    right = canvas.width - 0.5
    words = str(canvas.rng.choice(SHOPS))
    canvas.rectangle(0.4, 0, right + 0.1, 3.05, finish.accent)
    canvas.text(words, 0.8, 2.55, 0.34, (0.75, 0.7, 0.55))
    x = 0.6
    while x < right - 1.2:
        width = min(canvas.rng.uniform(1.3, 2.4), right - x)
        _glass(canvas, x, 0.5, x + width - 0.12, 2.3)
        for _ in range(12):
            a, z = canvas.rng.uniform(x + 0.1, x + width - 0.5), canvas.rng.uniform(0.5, 1.5)
            colour = tuple(float(v) for v in canvas.rng.uniform(0.03, 0.6, 3))
            canvas.rectangle(a, z, a + 0.25, z + 0.25, colour)  # type: ignore[arg-type]
        x += width


def _additions(canvas: Canvas, finish: Finish) -> None:
    """Creepers, pipes, posters and cracks: walls of one kind differ by them."""
    rng = canvas.rng
    if rng.random() < 0.25:
        _creeper(canvas)
    if rng.random() < 0.7:
        x = rng.choice([0.15, canvas.width - 0.15])
        canvas.line((x, 0), (x, finish.eaves), (0.22, 0.22, 0.22), 0.08)
    for _ in range(rng.integers(0, 4)):
        x, z = rng.uniform(0.5, max(0.6, canvas.width - 1)), rng.uniform(0.8, 1.6)
        colour = tuple(float(v) for v in rng.uniform(0.05, 0.7, 3))
        canvas.rectangle(x, z, x + 0.4, z + 0.55, colour, 0.2)  # type: ignore[arg-type]
    for _ in range(rng.integers(1, 5)):
        x, z = rng.uniform(0, canvas.width), rng.uniform(0, canvas.height)
        for _ in range(8):
            end = x + rng.uniform(-0.25, 0.25), z + rng.uniform(0.05, 0.3)
            canvas.line((x, z), end, (0.1, 0.1, 0.1), 0.02)
            x, z = end


def _creeper(canvas: Canvas) -> None:
    x, z = canvas.coordinates()
    middle, reach = canvas.rng.uniform(0, canvas.width), canvas.rng.uniform(1.0, 2.5)
    body = 1.2 - np.abs(x - middle) / reach - z / canvas.rng.uniform(3.0, 7.0)
    share = np.clip(3 * (body + 0.35 * canvas.noise(0.06, 1.2)), 0, 1)
    leaf = canvas.noise(0.04, 0.2)
    canvas.blend(np.asarray(share * (leaf > 0), np.float32), (0.06, 0.15, 0.04))
    canvas.blend(np.asarray(share * (leaf <= 0), np.float32), (0.03, 0.07, 0.02))
