"""``splatmake publish``: a folder with the page of a scene and the files that it links to."""

from __future__ import annotations

import html
import re
import shutil
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote, unquote

from pipeline.runtime.atomic import replace_folder
from pipeline.runtime.errors import UserError
from pipeline.runtime.record import RECORDS

PAGE, ENTRY, EXPORTS, REPORT = "report.html", "index.html", "export", "report"

# The line in the page's head by which a published folder is recognised.
MARK = '<meta name="generator" content="splatmake">'

# Exported files, and the scene's Gaussians if they are too many for the page.
_LINK = re.compile(rf'(?:href="({EXPORTS}/[^"/]+)"|data-file="({REPORT}/[^"/]+)")')
_LABELS = {
    "point_cloud.ply": "Gaussians, for every program (PLY)",
    "point_cloud.spz": "Gaussians, compact (SPZ)",
    "point_cloud_v4.spz": "Gaussians, compact (SPZ 4)",
    "point_cloud.sog": "Gaussians, compact, for PlayCanvas (SOG)",
    "point_cloud.splat": "Gaussians, for web viewers (.splat)",
    "point_cloud.glb": "Gaussians (glTF)",
    "point_cloud.usdc": "Gaussians (OpenUSD)",
    "mesh.glb": "Mesh with a texture (glTF)",
    "mesh.ply": "Mesh with colours at its vertices (PLY)",
    "points.ply": "Sparse points (PLY)",
    "dense_points.ply": "Dense points (PLY)",
    "orthophoto.tif": "Orthophoto (GeoTIFF)",
    "dsm.tif": "Surface model (GeoTIFF)",
    "dense_points.laz": "Dense points (LAZ)",
    "accuracy.html": "Accuracy of the maps",
    "transforms.json": "Cameras (transforms.json)",
    "video.mp4": "Video",
    "path.json": "Camera path of the video (JSON)",
}


class Download(NamedTuple):
    """A file that the page offers: the link relative to the page, what it is, and its size."""

    link: str
    label: str
    size: str


def downloads(exports: Path) -> list[Download]:
    """The files of the export stage, those that most people need first.

    Args:
        exports: The folder of the stage.
    """
    files = [p for p in exports.iterdir() if p.is_file() and p.name not in (*RECORDS, "frame.json")]
    places = {name: place for place, name in enumerate(_LABELS)}
    files.sort(key=lambda file: (places.get(file.name, len(places)), file.name))
    return [
        Download(
            f"{EXPORTS}/{quote(file.name)}",
            _LABELS.get(file.name, file.name),
            f"{max(file.stat().st_size / 1e6, 0.1):,.1f} MB",
        )
        for file in files
    ]


def publish(scene: Path, target: Path) -> list[str]:
    """Write a folder to upload: the page as ``index.html``, and the files it links to.

    Args:
        scene: The folder of a finished scene, ``results/NAME``.
        target: The folder to write. One that was published before is replaced.

    Returns:
        Lines that say what was written.

    Raises:
        UserError: The scene has no page, a file that the page offers is missing, or ``target``
            holds something else.
    """
    page = scene / PAGE
    try:
        links = [one or other for one, other in _LINK.findall(page.read_text("utf-8"))]
    except FileNotFoundError:
        raise UserError(
            "expected the page of a finished scene, found none",
            file=page,
            fix="name the folder of a finished scene, as results/garden",
        ) from None
    _check_target(target)
    names = [ENTRY, *(unquote(html.unescape(link)) for link in dict.fromkeys(links))]
    target = target.absolute()
    made = target.with_name(f".{target.name}.partial")
    shutil.rmtree(made, ignore_errors=True)
    total = 0
    try:
        for name in names:
            source = page if name == ENTRY else scene / name
            if not source.is_file():
                raise UserError(
                    "the page offers this file, which is missing",
                    file=source,
                    fix="run the scene again",
                )
            (made / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, made / name)
            total += source.stat().st_size
        replace_folder(made, target)
    finally:
        shutil.rmtree(made, ignore_errors=True)
    lines = [f"{target / name}" for name in names]
    return [*lines, f"{total / 1e6:,.1f} MB: upload the folder, its page is {ENTRY}"]


def _check_target(target: Path) -> None:
    """Refuse a folder with files that ``publish`` did not write."""
    if target.is_dir():
        inside = {entry.name for entry in target.iterdir()}
        entry = target / ENTRY
        ours = entry.is_file() and MARK in entry.read_text("utf-8", errors="replace")[:2000]
        if not inside or (ours and inside <= {ENTRY, EXPORTS, REPORT}):
            return
        other = min(inside - {ENTRY, EXPORTS, REPORT} or inside)
        found = f"a folder with other files (first: {other})"
    elif target.exists() or target.is_symlink():
        found = "a file"
    else:
        return
    raise UserError(
        f"expected a new folder, an empty one or one published before, found {found}",
        file=target,
        fix="name another folder",
    )
