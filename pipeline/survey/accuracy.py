"""``accuracy.html``: how accurate the maps of a scene are, on one page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from pipeline.runtime.atomic import write_text
from pipeline.scene.georeference import Georeference, Residual
from pipeline.scene.reconstruction import Reconstruction
from pipeline.survey.map_frame import MapFrame

FILE = "accuracy.html"
_TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).with_name("templates")),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
    undefined=StrictUndefined,
)
_TEMPLATES.filters["fixed"] = lambda value, digits: f"{value:,.{digits}f}"


@dataclass(frozen=True)
class Mapped:
    """What was mapped.

    Attributes:
        frame: The map.
        pixel_m: The size of a pixel of the training views on the ground, metres.
        cell_m, surface_cell_m: The size of a cell of the orthophoto and of the surface model,
            metres; None without maps.
        area_m2: The area of the orthophoto; None without.
        overlap: The mean number of photographs that see a cell of it; None without.
    """

    frame: MapFrame
    pixel_m: float
    cell_m: float | None = None
    surface_cell_m: float | None = None
    area_m2: float | None = None
    overlap: float | None = None


class AxisErrors(NamedTuple):
    """Residuals along an axis, metres: mean, standard deviation about it, root mean square."""

    axis: str
    mean: float
    sigma: float
    rmse: float
    number: int


def axis_errors(residuals: Sequence[Residual]) -> list[AxisErrors]:
    """The residuals of the measurements that the fit uses, by axis; none for an axis without
    measurements."""
    used = [residual for residual in residuals if residual.used]
    values = {
        "x (east)": [residual.x_m for residual in used],
        "y (north)": [residual.y_m for residual in used],
        "z (up)": [residual.vertical_m for residual in used],
    }
    found = []
    for axis, column in values.items():
        known = np.array([value for value in column if value is not None])
        if len(known):
            rmse = float(np.sqrt((known**2).mean()))
            found.append(
                AxisErrors(axis, float(known.mean()), float(known.std()), rmse, len(known))
            )
    return found


def write_accuracy(
    out: Path, mapped: Mapped, model: Reconstruction, georeference: Georeference
) -> None:
    """Write the page.

    Args:
        model: The cameras and sparse points.
        georeference: The frame of the poses.
    """
    error = model.points.error[model.points.error >= 0]
    page = _TEMPLATES.get_template("accuracy.html.jinja").render(
        mapped=mapped,
        georeference=georeference,
        measured="ground control points" if georeference.method == "gcp" else "GPS positions",
        errors=axis_errors(georeference.residuals),
        num_photographs=len(model.images),
        cameras=[camera for _, camera in sorted(model.cameras.items())],
        reprojection_px=float(error.mean()) if len(error) else None,
        num_points=len(model.points),
    )
    write_text(out / FILE, page)
