"""Reading cameras without photographs from any supported file or folder."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

from pipeline.io import frame_json
from pipeline.io.colmap import has_model, read_model
from pipeline.io.names import PICTURE_SUFFIXES, NameIndex, is_inside
from pipeline.io.photofile import read_facts
from pipeline.io.transforms import Frame, find_transforms, read_frames, read_transforms
from pipeline.runtime.errors import UserError
from pipeline.scene.georeference import CartesianOrigin, Georeference
from pipeline.scene.normalization import IDENTITY, Normalization
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View

# Those that have the given poses.
GIVEN_STAGES = ("refine", "decode", "inspect")
STAGES_WITH_MODEL = ("train", "undistort", "sfm", "refine", "decode", "inspect")


def read_cameras(path: Path, *, exported: bool = False) -> Reconstruction:
    """Read cameras; photographs are not needed.

    Cameras of an export folder are returned in the world of the Gaussians there.

    Args:
        exported: Whether, for a results' folder, the model is an exported file: in the unit of the
            given poses. Otherwise the cameras are in the world that the scene was trained in.
        path: The folder of a COLMAP model, a scene's or results' folder with a model in
            ``sparse/0``, or a ``transforms.json`` or its folder.

    Raises:
        UserError: No cameras were found, or files are malformed.
    """
    is_results = (path / "plan.json").is_file()
    roots = [path / name for name in STAGES_WITH_MODEL] if is_results else [path]
    for root in roots:
        for folder in (root, root / "sparse" / "0", root / "sparse"):
            if has_model(folder):
                model = read_model(folder)
                if is_results:
                    unit = results_normalization(path) if exported else IDENTITY
                    return unit.without_origin().model_to_given(model)
                return _exported_origin(folder).model_to_scene(model)
    if path.is_file() or find_transforms(path):
        sizes = {frame.name: _size(frame) for frame in read_frames(path)}
        return _exported_origin(path).model_to_scene(read_transforms(path, sizes))
    raise UserError(
        "expected a COLMAP model (cameras and images, .bin or .txt, also in sparse/0) or a "
        "transforms.json, found neither",
        file=path,
        fix="name the folder or file that holds the cameras",
    )


def results_normalization(results: Path) -> Normalization:
    """From the world of the given poses to that of a scene's results."""
    folder = next((results / name for name in GIVEN_STAGES if (results / name).is_dir()), results)
    return Georeference.normalization_of(folder)


def _exported_origin(path: Path) -> Normalization:
    """From the world of exported cameras to that of the Gaussians beside them."""
    for folder in (path, path.parent, path.parent.parent):
        # Another program's file of this name is none of an export.
        with contextlib.suppress(UserError, OSError):
            found = frame_json.Frame.read(folder).georeference
            if found and found.method == "given" and isinstance(found.origin, CartesianOrigin):
                return Normalization(1.0, found.origin.array)
    return IDENTITY


def choose_views(views: list[View], names: Iterable[str], source: Path) -> list[View]:
    """The views with these names, in this order; names may omit the suffix.

    Args:
        source: The file or folder of the views, for error messages.

    Raises:
        UserError: No view has one of the names, or several have it.
    """
    by_name = {view.name: view for view in views}
    index = NameIndex(by_name)
    chosen = []
    for name in names:
        candidates = index.candidates(name)
        if len(candidates) > 1:
            raise UserError(
                f"{name!r} may mean {len(candidates)} views: {', '.join(candidates[:3])}",
                file=source,
                fix="write the complete name of one of them",
            )
        if not candidates:
            some = ", ".join(list(by_name)[:5])
            raise UserError(
                f"expected a view named {name!r}, found {len(views)} others ({some}, ...)",
                file=source,
                fix="choose one of these names",
            )
        chosen.append(by_name[candidates[0]])
    return chosen


def _size(frame: Frame) -> tuple[int, int]:
    """Width and height in pixels from the frame's ``w`` and ``h``, else from its image file."""
    fields = frame.fields
    width, height = fields.values.get("w"), fields.values.get("h")
    if isinstance(width, int | float) and isinstance(height, int | float):
        if not (0 < width < 2**31 and 0 < height < 2**31):  # False for NaN.
            what = f"impossible size {str(width)[:40]}x{str(height)[:40]}"
            raise fields.wrong(what, "correct w and h, in pixels")
        return round(width), round(height)
    for suffix in ("", *sorted(PICTURE_SUFFIXES)):
        picture = fields.file.parent / (frame.name + suffix)
        if is_inside(frame.name) and picture.is_file():
            facts = read_facts(picture)
            return facts.width, facts.height
    what = "expected the image's size (w and h) or the image, found neither"
    raise fields.wrong(what, "add w and h to the file, in pixels")
