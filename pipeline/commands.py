"""The commands for files of Gaussians: convert, render, evaluate."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image
from pydantic import TypeAdapter, ValidationError

from pipeline.config.schema import Evaluate
from pipeline.config.section import Box
from pipeline.export.selection import Region, select_gaussians
from pipeline.io.camera_files import choose_views, read_cameras
from pipeline.io.photofile import MAX_PIXELS
from pipeline.io.splat_files import (
    check_suffix,
    is_antialiased,
    is_exported,
    read_gaussians,
    write_gaussians,
)
from pipeline.metrics.evaluate import evaluate_views
from pipeline.metrics.evaluation import Evaluation
from pipeline.metrics.protocol import choose_protocol
from pipeline.plan.given_poses import MAX_COORDINATE
from pipeline.plan.posed_scene import posed_scene
from pipeline.render import BACKGROUNDS, RasterOptions
from pipeline.render.views import near_plane, render_rgb, to_bytes
from pipeline.runtime.atomic import write_bytes
from pipeline.runtime.errors import UserError
from pipeline.runtime.progress import track
from pipeline.scene.views import View, camera_views, scene_extent
from pipeline.splats.reduce import reduce_gaussians

# Longer side of the views that decide which Gaussians are converted, pixels.
_SELECTION_SIDE = 640


@dataclass(frozen=True)
class Rendering:
    """The settings for rendering.

    Attributes:
        background: "black" or "white"; None for that of the scene, else black.
        antialias: Whether to apply Mip-Splatting's opacity compensation; None to do as the scene
            was trained, else not.
        max_side: The longer side in pixels to which larger views are reduced; None for full size.
        threads: The number of threads, which does not affect results.
    """

    background: str | None
    antialias: bool | None
    max_side: int | None
    threads: int


@dataclass(frozen=True)
class Wanted:
    """Which Gaussians of a file are converted.

    Attributes:
        max_gaussians: The largest number of them; None for all.
        box: x0, y0, z0, x1, y1, z1 in the frame of the file; None for everything.
        subject: Whether only what most cameras have in their images is converted.
        cameras: The file that ``read_cameras`` reads; None without.
    """

    max_gaussians: int | None = None
    box: Sequence[float] | None = None
    subject: bool = False
    cameras: Path | None = None

    @property
    def region(self) -> Region:
        """The region for ``select_gaussians``.

        Raises:
            UserError: The corners are no box, there is a subject as well, or cameras that are
                needed are missing.
        """
        for name in ("max_gaussians", "subject"):
            if getattr(self, name) and self.cameras is None:
                raise UserError(
                    f"--{name.replace('_', '-')}: expected --cameras, which say what is seen",
                    fix="add --cameras results/NAME, a COLMAP model or a transforms.json",
                )
        if self.subject and self.box is not None:
            raise UserError("expected --box or --subject, found both", fix="leave one out")
        if self.box is None:
            return "subject" if self.subject else None
        try:
            return TypeAdapter(Box).validate_python(tuple(self.box))
        except ValidationError as error:
            what = error.errors()[0]["msg"].removeprefix("Value error, ")
            fix = "give the lower corner first, in the unit of the file"
            raise UserError(f"--box: {what}, found {list(self.box)}", fix=fix) from None


def convert(
    source: Path,
    target: Path,
    sh_degree: int,
    min_opacity: float,
    morton_order: bool,
    spz_version: int,
    wanted: Wanted,
    warnings: list[str],
) -> list[str]:
    """Convert a file of Gaussians to the format of ``target``'s suffix.

    Args:
        sh_degree, min_opacity, morton_order: The arguments of ``splats.reduce.reduce_gaussians``.
        spz_version: The version of an SPZ file that is written, 3 or 4.
        wanted: Which Gaussians are converted.
        warnings: The list that warnings are added to, also of what ``target`` does not hold.

    Returns:
        The messages for the user.

    Raises:
        UserError: A file cannot be read or written.
    """
    check_suffix(target)
    region = wanted.region
    found = read_gaussians(source, warnings)
    arrays, antialias, said = found.as_arrays(), is_antialiased(source), []
    if region is not None or (wanted.max_gaussians or len(found)) < len(found):
        views = _selection_views(source, wanted.cameras)
        options = RasterOptions(
            antialias=bool(antialias), near=near_plane(scene_extent(views)) if views else 0.01
        )
        chosen = select_gaussians(arrays, wanted.max_gaussians, region, views, options)
        arrays = chosen.gaussians
        said = [f"{source}: {text}" for text in chosen.decisions]
    made = reduce_gaussians(arrays, sh_degree, min_opacity, morton_order)
    warnings += write_gaussians(target, made, antialias=antialias, spz_version=spz_version)
    size = target.stat().st_size / 1e6
    before = f"{len(found)} Gaussians of SH degree {found.sh_degree}"
    return [f"{source}: {before}", *said, f"{target}: {len(made)} written, {size:.1f} MB"]


def _selection_views(model: Path, cameras: Path | None) -> list[View]:
    """The views that decide which Gaussians are converted, of a moderate size."""
    if cameras is None:
        return []
    views = camera_views(read_cameras(cameras, exported=is_exported(model)), _SELECTION_SIDE)
    _check_views(views, cameras)
    return views


def render(
    model: Path,
    cameras: Path,
    out: Path,
    names: Sequence[str],
    how: Rendering,
    warnings: list[str],
) -> list[str]:
    """Render a file of Gaussians from cameras, to 8-bit PNG files with the views' names.

    Args:
        cameras: The file that ``read_cameras`` reads.
        names: The names of the views to render; empty for all.
        how: The settings for rendering.
        warnings: The list that warnings are added to.

    Returns:
        The messages for the user.

    Raises:
        UserError: A file cannot be read, or no view has one of the names.
    """
    posed = read_cameras(cameras, exported=is_exported(model))
    views = camera_views(posed, how.max_side)
    if not views:
        raise UserError("expected cameras, found none", file=cameras, fix="use another model")
    _check_views(views, cameras)
    if not all(posed.cameras[image.camera_id].is_pinhole for image in posed.images.values()):
        warnings.append(f"{cameras}: lens distortion is not rendered")
    # The near plane depends on all views, so that it is independent of ``names``.
    options = RasterOptions(
        background=BACKGROUNDS[how.background or "black"],
        antialias=bool(how.antialias),
        near=near_plane(scene_extent(views)),
        threads=how.threads,
    )
    chosen = choose_views(views, names, cameras) if names else views
    gaussians = read_gaussians(model, warnings)
    files: set[Path] = set()
    for view in track(chosen, "rendering", len(chosen), unit="views"):
        rgb = render_rgb(gaussians, view, options)
        file = _png(out, view.name, files)
        files.add(file)
        buffer = io.BytesIO()
        Image.fromarray(to_bytes(rgb)).save(buffer, "PNG")
        write_bytes(file, buffer.getvalue())
    return [f"{out}: {len(chosen)} views rendered"]


def _check_views(views: Sequence[View], cameras: Path) -> None:
    """Raises: UserError: a view is too large to be rendered, or out of the range of positions."""
    for view in views:
        with np.errstate(over="ignore", invalid="ignore"):
            distance = float(np.abs(view.centre).max())
        if view.width * view.height > MAX_PIXELS or not distance <= MAX_COORDINATE:
            raise UserError(
                f"{view.name}: cannot be rendered: {view.width}x{view.height} pixels, "
                f"{distance:g} units from the origin",
                file=cameras,
                fix=f"use cameras of at most {MAX_PIXELS >> 20} megapixels (--max-side) and "
                f"{MAX_COORDINATE:g} units from the origin",
            )


def _png(folder: Path, name: str, taken: set[Path]) -> Path:
    """The path of a view's file, unique and inside ``folder`` even if its name is absolute or
    contains ".."."""
    inside = [part for part in PurePosixPath(name).parts if part not in ("/", "..")]
    plain = folder.joinpath(*inside)
    short = plain.with_suffix(".png")
    return short if short not in taken else plain.with_name(plain.name + ".png")


def evaluate(
    model: Path, scene: Path, out: Path | None, every: int | None, how: Rendering
) -> Evaluation:
    """Compare renders of a file of Gaussians, from any program, with a scene's photographs.

    Args:
        scene, every: The arguments of ``posed_scene``.
        out: The folder for ``evaluation.json`` and ``renders/``; None to write nothing.
        how: The settings for rendering.

    Returns:
        The result of ``evaluate_views``, with the warnings of all steps.

    Raises:
        UserError: A file or a scene cannot be read.
    """
    warnings: list[str] = []
    gaussians = read_gaussians(model, warnings)
    posed = posed_scene(scene, how.max_side, every, exported=is_exported(model))
    changed: dict[str, Any] = {"sh_degree": 3}
    if how.background is not None:
        changed["background"] = how.background
    if how.antialias is not None:
        changed["antialias"] = how.antialias
    train = posed.train.model_copy(update=changed)
    protocol = choose_protocol(posed.views, posed.split, train)
    with tempfile.TemporaryDirectory() as scratch:
        found = evaluate_views(
            gaussians,
            protocol,
            Evaluate(),
            train,
            Path(scratch) if out is None else out / "renders",
            gains=posed.gains,
            threads=how.threads,
        )
    found = found.model_copy(update={"warnings": (*warnings, *posed.warnings, *found.warnings)})
    if out is not None:
        found.write(out)
    return found
