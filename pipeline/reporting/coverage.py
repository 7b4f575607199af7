"""The coverage section of a report page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.coverage.record import (
    CoverageRecord,
    ErrorByTrust,
    NovelPlace,
    NovelViewCoverage,
    ProposedViewpoint,
    ViewCoverage,
)
from pipeline.reporting.data import SceneResults, TrainedScene
from pipeline.reporting.pictures import Embedded, embedded, trust_colours, trust_gradient, upright
from pipeline.reporting.space import upright_frame
from pipeline.reporting.text import count, fixed
from pipeline.scene.views import View

# Pixels: the side of the map, and the length of the line that shows a viewing direction.
_ABOVE, _MARGIN, _TICK = 440, 28, 17


@dataclass(frozen=True)
class Above:
    """Map of the cameras and proposed viewpoints from above, in pixels.

    Attributes:
        cameras: The view, x and y of each camera.
        viewpoints: For each viewpoint x and y, and those of the end of its viewing direction.
    """

    width: int
    height: float
    cameras: Sequence[tuple[View, float, float]]
    viewpoints: Sequence[tuple[float, ...]]


@dataclass(frozen=True)
class CoverageContent:
    """What the section shows beside the record.

    Attributes:
        worst: The test views of least trust.
        facts: The names and values.
        above: The map; None without viewpoints.
        gradient: The colours of trust as CSS.
        pictures: The images of the record by name.
    """

    worst: Sequence[ViewCoverage]
    facts: Sequence[tuple[str, str]]
    above: Above | None
    gradient: str
    pictures: Mapping[str, NDArray[np.uint8]]

    def pair(
        self, entry: ViewCoverage | ProposedViewpoint, orientation: int
    ) -> list[tuple[str, Embedded]]:
        """The render and the trust map of a view, rotated by an EXIF orientation."""
        assert entry.render is not None and entry.trust_map is not None
        trust = trust_colours(self.pictures[entry.trust_map])
        pictures = {"render": self.pictures[entry.render], "trust": trust}
        return [(kind, embedded(upright(p, orientation))) for kind, p in pictures.items()]

    def novel_pair(self, entry: NovelPlace, orientation: int) -> list[tuple[str, Embedded]]:
        """The render and the map of a novel view, rotated by an EXIF orientation."""
        files = {"render": entry.render, "contradictions": entry.map}
        return [
            (kind, embedded(upright(self.pictures[file], orientation)))
            for kind, file in files.items()
        ]


def coverage_content(results: SceneResults) -> CoverageContent:
    """The content of the section."""
    shown = results.coverage
    views = [view for view in shown.record.views if view.trust_map is not None]
    return CoverageContent(
        worst=sorted(views, key=lambda view: view.mean_trust or 0.0),
        facts=_facts(shown.record),
        above=_above(shown.record.viewpoints, results.trained),
        gradient=trust_gradient(),
        pictures=shown.pictures,
    )


def _facts(record: CoverageRecord) -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    if record.surface is not None:
        seen = record.surface.seen_by
        shares = f"by 1: {seen.one:.1%}, by 2: {seen.two:.1%}, by 3 or more: "
        rows += [
            ("surface seen by photographs", f"{shares}{seen.three_or_more:.1%}"),
            ("parallax, median", f"{fixed(record.surface.median_parallax_deg, 0)}\u00b0 or more"),
        ]
    if record.views:
        holes = np.mean([view.hole_share for view in record.views])
        floating = np.mean([view.floater_share for view in record.views])
        rows += [
            ("holes in test views", f"{holes:.2%} of pixels"),
            ("floaters in test views", f"{floating:.2%} of pixels"),
        ]
    if record.novel_views is not None:
        rows += _novel_rows(record.novel_views)
    if record.floaters is not None:
        by_camera = record.floaters.by_camera
        near = ", ".join(f"{name} ({number})" for name, number in by_camera.items())
        number = f"{count(record.floaters.num_gaussians)} Gaussians"
        rows.append(("floaters near cameras", number + (f", near {near}" if near else "")))
    if record.error is not None:
        rows += _error_rows(record.error)
    return rows


def _novel_rows(novel: NovelViewCoverage) -> list[tuple[str, str]]:
    kinds = novel.by_kind.items()
    contradicted = ", ".join(f"{kind} {row.contradicted_share:.1%}" for kind, row in kinds)
    unseen = ", ".join(f"{kind} {row.unseen_share:.1%}" for kind, row in kinds)
    number = sum(row.num_views for _, row in kinds)
    return [
        (f"contradicted in {number} novel views", f"{contradicted} of pixels"),
        ("in no photograph, in the same views", f"{unseen} of pixels"),
    ]


def _error_rows(error: ErrorByTrust) -> list[tuple[str, str]]:
    rows = []
    if error.rank_correlation is not None:
        text = (
            f"rank correlation {_signed(error.rank_correlation)} over {count(error.num_blocks)} "
            "blocks of test views (\u22121: low trust always means high error; 0: no relation)"
        )
        rows.append(("trust and squared error", text))
    for row in error.by_trust:
        low, high = row.trust_range
        text = f"{fixed(row.rmse, 3)} ({row.share:.1%} of blocks)"
        rows.append((f"RMS error where trust is {low:g} to {high:g}", text))
    return rows


def _above(viewpoints: Sequence[ProposedViewpoint], scene: TrainedScene) -> Above | None:
    if not scene.views or not viewpoints:
        return None
    rotations = np.stack([view.world_to_camera[:3, :3] for view in scene.views])
    frame = upright_frame(rotations, scene.up)
    plan = frame[[0, 2]]
    cameras = np.stack([view.centre for view in scene.views]) @ plan.T
    positions = np.array([v.position for v in viewpoints])
    places = scene.normalization.to_scene(positions) @ plan.T
    both = np.concatenate([cameras, places])
    low, size = both.min(axis=0), float(np.ptp(both, axis=0).max())
    scale = (_ABOVE - 2 * _MARGIN) / size if size > 0 else 1.0
    height = 2 * _MARGIN + scale * float(np.ptp(both[:, 1]))

    def at(place: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(_MARGIN + (place - low) * scale)

    starts = at(places)
    ends = starts + _TICK * (np.array([v.direction for v in viewpoints]) @ plan.T)
    return Above(
        width=_ABOVE,
        height=height,
        cameras=[(view, *at) for view, at in zip(scene.views, at(cameras).tolist(), strict=True)],
        viewpoints=np.hstack([starts, ends]).tolist(),
    )


def _signed(value: float) -> str:
    return fixed(value, 2).replace("-", "\u2212")
