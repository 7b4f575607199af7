"""Writes what was invented: ``holes.json``, masks and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.holes.fill import FilledScene, invented_pixels
from pipeline.holes.record import HolesRecord, InventedView, PaintedHoles
from pipeline.render import RasterOptions
from pipeline.render.views import render_rgb, to_bytes, write_png
from pipeline.scene.views import View

#: Number of painted views, those with the largest holes, whose pictures are written.
SHOWN = 2


def write_holes(
    out: Path, scene: FilledScene, views: Sequence[View], fill: str, options: RasterOptions
) -> HolesRecord:
    """Write ``holes.json`` and its pictures.

    Args:
        out: The folder of the stage.
        views: The evaluated views.
        fill: The option ``holes.fill``.
        options: How views are rendered.
    """
    shares = [hole.share for hole in scene.found]
    shown = sorted(range(len(shares)), key=lambda i: -shares[i])[:SHOWN]
    record = HolesRecord(
        painter="inpaint" if fill == "inpaint" else "command",
        num_invented=scene.num_invented,
        painted=tuple(_painted(out, scene, i, options, i in shown) for i in range(len(shares))),
        views=tuple(_view(out, scene, index, view, options) for index, view in enumerate(views)),
    )
    record.write(out)
    return record


def _painted(
    out: Path, scene: FilledScene, index: int, options: RasterOptions, shown: bool
) -> PaintedHoles:
    found = scene.found[index]
    view = found.probe.view
    files = {name: f"painted/{index:02d}_{name}.png" for name in ("before", "mask", "after")}
    if shown:
        after = to_bytes(render_rgb(scene.gaussians, view, options))
        pictures = found.probe.rgb, _white(found.hole), after
        for file, picture in zip(files.values(), pictures, strict=True):
            write_png(out / file, picture)
    return PaintedHoles(
        world_to_camera=np.round(view.world_to_camera, 9).tolist(),
        width=view.width,
        height=view.height,
        hole_share=round(found.share, 4),
        **(files if shown else {}),
    )


def _view(
    out: Path, scene: FilledScene, index: int, view: View, options: RasterOptions
) -> InventedView:
    invented, mask = invented_pixels(scene, view, options), None
    if invented.any():
        mask = f"masks/{index:04d}.png"
        write_png(out / mask, _white(invented))
    return InventedView(name=view.name, invented_share=round(float(invented.mean()), 4), mask=mask)


def _white(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return np.where(mask, np.uint8(255), np.uint8(0))
