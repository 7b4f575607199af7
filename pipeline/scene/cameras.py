"""Cameras from wherever they stand, for rendering and evaluating outside the pipeline's DAG."""

from __future__ import annotations

import json
import posixpath
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.config.schema import Config, Split, Train, Views
from pipeline.runtime.errors import UserError
from pipeline.scene.colmap import has_model, read_model
from pipeline.scene.given import load_given
from pipeline.scene.manifest import Manifest
from pipeline.scene.model import Reconstruction, View
from pipeline.scene.names import PICTURE_SUFFIXES, NameIndex
from pipeline.scene.photofile import read_facts
from pipeline.scene.scan import scan
from pipeline.scene.transforms import Frame, find_transforms, read_frames, read_transforms
from pipeline.scene.views import load_views, view_size

# Folders of a finished scene, those nearest to training first.
_WITH_PHOTOS = ("undistort", "decode", "inspect")
_WITH_MODEL = ("train", "undistort", "sfm", "refine", "decode", "inspect")


@dataclass(frozen=True)
class PosedScene:
    """Views with photographs, and the settings they were, or are to be, used with.

    Attributes:
        gains: file of each photograph's exposure gains (``exposure.json``), None without one.
        warnings: what its photographs or poses lack.
    """

    views: list[View]
    split: Split
    train: Train
    gains: Path | None
    warnings: tuple[str, ...]


def read_cameras(path: Path) -> Reconstruction:
    """The cameras in a COLMAP model's folder, in a scene or results folder that holds one
    (``sparse/0``), or in a ``transforms.json``; no photograph is needed.

    Raises:
        UserError: none found, or malformed.
    """
    is_results = (path / "plan.json").is_file()
    roots = [path / name for name in _WITH_MODEL] if is_results else [path]
    for root in roots:
        for folder in (root, root / "sparse" / "0", root / "sparse"):
            if has_model(folder):
                return read_model(folder)
    if path.is_file() or find_transforms(path):
        sizes = {frame.path: _size(frame) for frame in read_frames(path)}
        return read_transforms(path, sizes)
    raise UserError(
        "expected a COLMAP model (cameras and images, .bin or .txt, also in sparse/0) or a "
        "transforms.json, found neither",
        file=path,
        fix="name the folder or file that holds the cameras",
    )


def camera_views(model: Reconstruction, max_long_side: int | None) -> list[View]:
    """The model's images as views without photographs, sorted by name, lens distortion left out;
    a folder that they all lie in is left out of their names.

    Args:
        max_long_side: pixels; larger views are reduced to it.
    """
    folders = {posixpath.dirname(image.name) for image in model.images.values()}
    mixed = len({posixpath.isabs(folder) for folder in folders}) != 1
    shared = "" if mixed else posixpath.commonpath(folders)
    views = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        camera = model.cameras[image.camera_id]
        width, height = view_size(camera.width, camera.height, max_long_side or 2**31)
        fx, fy, cx, cy = camera.resized(width, height).pinhole
        pose = image.world_to_camera
        name = image.name[len(shared) :].lstrip("/")
        views.append(View(name, "", None, width, height, fx, fy, cx, cy, pose, False))
    return views


def choose_views(views: list[View], names: Iterable[str], source: Path) -> list[View]:
    """The views of these names, with or without suffix.

    Raises:
        UserError: there is none of a name.
    """
    by_name = {view.name: view for view in views}
    index = NameIndex(by_name)
    chosen = []
    for name in names:
        found = index.find(name)
        if found is None:
            some = ", ".join(list(by_name)[:5])
            raise UserError(
                f"expected a view named {name!r}, found {len(views)} others ({some}, ...)",
                file=source,
                fix="name one of them",
            )
        chosen.append(by_name[found])
    return chosen


def posed_scene(folder: Path, max_long_side: int | None, every: int | None) -> PosedScene:
    """The views to measure a model on.

    Args:
        folder: a finished scene (``results/NAME``), whose settings hold; or photographs with
            poses, as the pipeline takes them as input.
        max_long_side: of views, pixels; None: the finished scene's, else the photographs' own.
        every: each this-many-th view counts as held out, 0 none; None: the finished scene's
            setting, else the default.

    Raises:
        UserError: no such scene, no poses, cameras with lens distortion.
    """
    if (folder / "plan.json").is_file():
        return _finished(folder, max_long_side, every)
    side = Views(max_long_side_px=max_long_side or 2**31)
    split = Split() if every is None else Split(holdout_every=every)
    found = scan(folder, folder.name, Config(views=side), cache=None)
    if found.poses is None:
        raise UserError(
            "expected photographs with poses (a COLMAP model in sparse/0, transforms.json or "
            "poses_bounds.npy), found no poses",
            file=folder,
            fix="add them, or give a finished scene's results folder",
        )
    model = load_given(found).model
    _check_pinhole(model, folder)
    views = load_views(found.manifest, model, side, split)
    train = Train(background="white" if found.num_alpha else "black")
    return PosedScene(views, split, train, None, found.warnings)


def _finished(folder: Path, max_long_side: int | None, every: int | None) -> PosedScene:
    record = folder / "train" / "stage.json"
    try:
        sections = json.loads(record.read_text())["key"]["config"]
        views = Views.model_validate(sections["views"])
        split = Split.model_validate(sections["split"])
        train = Train.model_validate(sections["train"])
    except (OSError, ValueError, KeyError) as error:
        raise UserError(
            f"expected a finished scene, could not read its settings: {error}",
            file=record,
            fix=f"run snakemake {folder}/metrics.json with this version of the program",
        ) from None
    if max_long_side is not None:
        views = views.model_copy(update={"max_long_side_px": max_long_side})
    if every is not None:
        split = split.model_copy(update={"holdout_every": every})
    photos = _first(folder, _WITH_PHOTOS, "images.json")
    model = read_model(_first(folder, _WITH_MODEL, "sparse/0"))
    _check_pinhole(model, folder)
    # Photographs that no stage copied are named as seen from where Snakemake ran.
    root = folder.absolute().parent.parent
    found = [
        replace(view, image=_from(root, view.image), mask=view.mask and _from(root, view.mask))
        for view in load_views(Manifest.read(photos), model, views, split)
    ]
    gains = folder / "train" / "exposure.json"
    return PosedScene(found, split, train, gains if gains.is_file() else None, ())


def _first(folder: Path, stages: tuple[str, ...], name: str) -> Path:
    """The file or folder ``name`` of the first of the stages that the scene's plan runs and that
    made one."""
    planned = json.loads((folder / "plan.json").read_text())["stages"]
    for stage in stages:
        path = folder / stage / name
        if planned.get(stage, {}).get("run") and path.exists():
            return path
    raise UserError(
        f"expected a finished scene, found no {name}",
        file=folder,
        fix=f"run snakemake {folder}/metrics.json",
    )


def _from(root: Path, file: str) -> str:
    return file if Path(file).exists() else str(root / file)


def _check_pinhole(model: Reconstruction, source: Path) -> None:
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        if not camera.is_pinhole:
            raise UserError(
                f"{image.name}: its {camera.model} camera has lens distortion, which renders have "
                "not",
                file=source,
                fix="undistort the photographs first: run the pipeline on them and give its "
                "results folder",
            )


def _size(frame: Frame) -> tuple[int, int]:
    """Pixels of a frame's picture: as the file says, else as its picture, if it is there, says."""
    width, height = frame.fields.get("w"), frame.fields.get("h")
    if isinstance(width, int | float) and isinstance(height, int | float):
        return round(width), round(height)
    for suffix in ("", *sorted(PICTURE_SUFFIXES)):
        picture = frame.file.parent / (frame.path + suffix)
        if picture.is_file():
            facts = read_facts(picture)
            return facts.width, facts.height
    raise UserError(
        f"{frame.source}: expected the picture's size (w and h) or the picture, found neither",
        file=frame.file,
        fix="add w and h to the file, in pixels",
    )
