"""What the photographs of a scene did not see: ``coverage.json`` and its pictures."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.config.schema import Train
from pipeline.coverage.defects import floating, holes, near_floaters
from pipeline.coverage.probe_views import Bools, Doubles, Draw, Eye, Floats, open_eyes, points_of
from pipeline.coverage.summary import describe
from pipeline.coverage.trust import LITTLE, gather, trust_pictures
from pipeline.coverage.viewpoints import Outlook, propose
from pipeline.metrics.evaluate import Protocol, reference
from pipeline.photos.load import load_view, resize_area
from pipeline.render.views import Render, render_view, to_bytes
from pipeline.runtime.atomic import write_bytes, write_json
from pipeline.runtime.progress import track
from pipeline.scene.manifest import Manifest
from pipeline.scene.views import View, scene_up
from pipeline.splats.gaussians import Gaussians

T = TypeVar("T")

#: Of more views, so many are looked at, evenly spread.
MAX_PHOTOGRAPHS, MAX_HELD_OUT, MAX_SAMPLED = 200, 12, 12
#: Pictures kept: the held-out views of least trust.
SHOWN = 2
#: Error and trust are compared as means over squares of so many pixels of the maps.
BLOCK = 8
#: Fewer squares tell nothing of a correlation.
MIN_BLOCKS = 50
#: Classes of trust, for the error in each.
CLASSES = (0.0, 0.25, 0.5, 0.75, 1.0)
FORMULA = (
    "precision (how far a point may be off in this view, by triangulation from the photographs "
    "that see it) times support (how near in direction, and how sharp, the nearest is); 0 to 1"
)


@dataclass(frozen=True)
class Asked:
    """A held-out view: what it shows, how far that is to be trusted, and how wrong it is.

    Attributes:
        trust, squared_error: (H, W); the error is the mean over channels, of a range of 1.
        counts: (H, W) pixels that are measured.
        record: what ``coverage.json`` says of it.
    """

    eye: Eye
    trust: Floats
    squared_error: Floats
    counts: Bools
    record: dict[str, Any]


@dataclass(frozen=True)
class World:
    """The frame of the views.

    Attributes:
        up: (3,) unit vector.
        unit: name of the unit of its lengths, None where it has none.
    """

    up: Doubles
    unit: str | None


def world_of(
    views: Sequence[View], manifest: Manifest, georeference: Mapping[str, Any] | None
) -> World:
    """The frame of the views: up as their photographs were held, and metres where the model's
    ``georeference.json`` says so."""
    unit = str((georeference or {}).get("unit", ""))
    return World(scene_up(views, manifest), "m" if unit.startswith("metres") else None)


def measure_coverage(
    out: Path,
    gaussians: Gaussians,
    views: Sequence[View],
    protocol: Protocol,
    train: Train,
    evaluation: Mapping[str, Any],
    renders: Path,
    world: World,
    threads: int,
) -> dict[str, Any]:
    """Write ``coverage.json`` and ``coverage/*.png`` into the folder ``out``.

    Args:
        views: all with a pose.
        evaluation: what ``evaluate_views`` returned.
        renders: folder of the renders that it names.
        threads: views rendered or judged at a time.

    Returns:
        The content of ``coverage.json``.
    """

    options = protocol.options(train, threads=1)

    def draw(view: View) -> Render:
        return render_view(gaussians, view, options)

    training = _evenly([view for view in views if not view.is_test], MAX_PHOTOGRAPHS)
    opened = open_eyes(training, draw, threads)
    eyes = list(track(opened, "looking at what was seen", len(training), unit="views"))
    depths = np.concatenate([eye.depth[~eye.open] for eye in eyes])
    result: dict[str, Any] = {
        "photographs": sum(not view.is_test for view in views),
        "looked_at": len(eyes),
        "trust": FORMULA,
    }
    if not len(depths):
        return _written(out, result | {"reason": "the scene shows no surface"})
    beyond = float(np.percentile(depths, 95))
    surface, nearest = _surface(_evenly(eyes, MAX_SAMPLED), eyes, beyond)
    asked = _held_out(evaluation, renders, protocol, eyes, draw, beyond, nearest, threads)
    # All photographs that there are: nobody need take a held-out one again.
    known = [*eyes, *(item.eye for item in asked)]
    cameras = [*training, *(_named(views, item.eye.view.name) for item in asked)]
    outlook = propose(cameras, known, draw, world.up, beyond, threads)
    floaters = near_floaters(gaussians, eyes, known[len(eyes) :], nearest)
    result |= {
        "surface": surface,
        "views": [item.record for item in asked],
        "error": _agreement(asked),
        "floaters": {
            "gaussians": floaters.count,
            "within": floaters.within,
            "cameras": floaters.cameras,
        },
        "surroundings": {
            "viewpoints": len(outlook.judged),
            "trust": outlook.before,
            "trust_with_proposals": outlook.after,
        },
        "viewpoints": _proposals(outlook, known, world),
    }
    shown = [item for item in asked if item.record["trust"] is not None]
    shown = sorted(shown, key=lambda item: item.record["trust"])[:SHOWN]
    for i, item in enumerate(shown):
        item.record.update(_pictures(out, f"view_{i + 1}", item.eye, item.trust))
    proposed = [proposal.eye for proposal in outlook.proposals]
    for i, (picture, _) in enumerate(trust_pictures(proposed, known, beyond, threads)):
        result["viewpoints"][i] |= _pictures(out, f"next_{i + 1}", proposed[i], picture)
    return _written(out, result)


def _written(out: Path, result: dict[str, Any]) -> dict[str, Any]:
    write_json(out / "coverage.json", result)
    return result


def _evenly(items: Sequence[T], count: int) -> list[T]:
    picks = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[i] for i in picks]


def _named(views: Sequence[View], name: str) -> View:
    return next(view for view in views if view.name == name)


def _surface(
    asking: Sequence[Eye], eyes: Sequence[Eye], beyond: float
) -> tuple[dict[str, Any], float]:
    """How well what training views show is covered, and how near the nearest of it is."""
    counts, parallax, depth = [], [], []
    for eye in track(asking, "counting who sees what", len(asking), unit="views"):
        points = points_of(eye, beyond, 4)
        evidence = gather(eyes, points)
        met = ~points.open & (evidence.count > 0)
        counts.append(evidence.count[met])
        parallax.append(evidence.parallax[met])
        depth.append(eye.focal / points.sharpness[met])
    count, angle, z = (np.concatenate(values) for values in (counts, parallax, depth))
    if not len(count):
        return {}, 0.0
    agreed = z[count > 2]
    seen_by = {
        "1": _share(count == 1),
        "2": _share(count == 2),
        "3 or more": _share(count > 2),
    }
    return {
        "seen_by": seen_by,
        "median_photographs": float(np.median(count)),
        "median_parallax_deg": _rounded(np.median(angle)),
    }, float(np.percentile(agreed, 2)) if len(agreed) else 0.0


def _held_out(
    evaluation: Mapping[str, Any],
    renders: Path,
    protocol: Protocol,
    eyes: Sequence[Eye],
    draw: Draw,
    beyond: float,
    nearest: float,
    threads: int,
) -> list[Asked]:
    by_name = {view.name: view for view in protocol.views if view.is_test}
    measured = [item for item in evaluation["per_view"] if item["name"] in by_name]
    measured = _evenly(measured, MAX_HELD_OUT)
    views = [by_name[item["name"]] for item in measured]
    asking = list(open_eyes(views, draw, threads))
    mapped = trust_pictures(asking, eyes, beyond, threads)
    mapped = track(mapped, "mapping trust", len(measured), unit="views")
    result = []
    for item, view, eye, (picture, evidence) in zip(measured, views, asking, mapped, strict=True):
        pixels = load_view(view)
        photo = reference(pixels, protocol.background)
        with Image.open(renders / item["render"]) as render:
            error = ((np.asarray(render) / 255.0 - photo / 255.0) ** 2).mean(axis=2)
        height, width = eye.depth.shape
        opaque, counts = None, eye.counts
        if pixels.alpha is not None:
            opaque = resize_area(pixels.alpha, width, height) > 127
            counts = counts & (opaque | ~eye.open)
        record = {
            "name": view.name,
            "psnr": item["psnr"],
            "trust": _rounded(picture[counts].mean()) if counts.any() else None,
            "little_trust": _share(picture[counts] < LITTLE),
            "holes": _share(holes(eye, evidence, opaque)[counts]),
            "floating": _share(floating(eye, evidence, nearest)[counts]),
            "median_photographs": float(np.median(evidence.count)),
        }
        small = resize_area(error.astype(np.float32), width, height)
        result.append(Asked(eye, picture, small, counts, record))
    return result


def _agreement(asked: Sequence[Asked]) -> dict[str, Any]:
    """Whether trust tells the error of held-out views."""
    from scipy.stats import spearmanr

    pairs = [_blocks(item) for item in asked]
    trusted, error = (
        np.concatenate([pair[i] for pair in pairs]) if pairs else np.zeros(0) for i in (0, 1)
    )
    classes = np.digitize(trusted, CLASSES[1:-1])
    constant = len(trusted) < MIN_BLOCKS or np.ptp(trusted) == 0 or np.ptp(error) == 0
    return {
        "squares": len(trusted),
        "square_px": BLOCK,
        "rank_correlation": None if constant else _rounded(spearmanr(trusted, error).statistic),
        "by_trust": [
            {
                "trust": [low, high],
                "share": _share(classes == i),
                "rmse": _rounded(np.sqrt(error[classes == i].mean()), 4),
            }
            for i, (low, high) in enumerate(pairwise(CLASSES))
            if (classes == i).any()
        ],
    }


def _blocks(item: Asked) -> tuple[NDArray[Any], NDArray[Any]]:
    """Mean trust and mean squared error of the squares of which half the pixels count."""
    height, width = (side // BLOCK * BLOCK for side in item.counts.shape)

    def total(values: NDArray[Any]) -> Doubles:
        squares = values[:height, :width].astype(np.float64)
        return squares.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK).sum(axis=(1, 3))

    number = total(item.counts)
    enough = number >= BLOCK * BLOCK / 2
    return tuple(  # type: ignore[return-value]
        total(values * item.counts)[enough] / number[enough]
        for values in (item.trust, item.squared_error)
    )


def _proposals(outlook: Outlook, known: Sequence[Eye], world: World) -> list[dict[str, Any]]:
    missing = max(1 - outlook.before, 1e-9)
    return [
        {
            "where": describe(proposal.viewpoint, known, world.up, world.unit),
            "position": _rounded(proposal.viewpoint.view.centre, 6),
            "direction": _rounded(proposal.viewpoint.view.world_to_camera[2, :3], 6),
            "look_at": _rounded(proposal.viewpoint.subject, 6),
            "world_to_camera": _rounded(proposal.viewpoint.view.world_to_camera, 9),
            "unknown_percent": _rounded(100 * proposal.unknown, 1),
            "gain_percent": _rounded(100 * proposal.gain / missing, 1),
        }
        for proposal in outlook.proposals
    ]


def _pictures(out: Path, name: str, eye: Eye, picture: Floats) -> dict[str, str]:
    """Write what a camera shows and how far to trust it (grey, white is 1)."""
    files = {"render": f"coverage/{name}_render.png", "trust_map": f"coverage/{name}_trust.png"}
    for file, values in zip(files.values(), (eye.rgb, picture), strict=True):
        buffer = io.BytesIO()
        Image.fromarray(to_bytes(values)).save(buffer, "PNG")
        write_bytes(out / file, buffer.getvalue())
    return files


def _share(where: NDArray[Any]) -> float:
    return round(float(where.mean()), 4) if where.size else 0.0


def _rounded(values: Any, digits: int = 3) -> Any:
    return np.round(np.asarray(values, np.float64), digits).tolist()
