"""The components of a scene: the models into which its photographs fall.

Models are joined where a joint is sound; the others are kept, and any of them can be used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from pipeline.runtime.text import counted
from pipeline.sfm.attempts import Attempt
from pipeline.sfm.consistency import missing_covisibility
from pipeline.sfm.continuity import Names
from pipeline.sfm.counters import ComponentSummary
from pipeline.sfm.evidence import collect_evidence, read_verified_pairs
from pipeline.sfm.joining import join_models
from pipeline.sfm.joints import Joint, find_joint
from pipeline.sfm.judge import (
    MAX_MISSING_COVISIBILITY,
    MIN_AGREEING_PAIRS,
    Evidence,
    Verdict,
    judge,
)
from pipeline.sfm.last_adjustment import adjust_last
from pipeline.sfm.left_out import register_left_out
from pipeline.sfm.matching import list_names
from pipeline.sfm.model_views import read_views
from pipeline.sfm.refine import bundle_adjust

GRADES = ("failed", "weak", "good")


@dataclass(frozen=True)
class Component:
    """A model with its quality."""

    model: pycolmap.Reconstruction
    evidence: Evidence
    verdict: Verdict

    @property
    def photographs(self) -> set[int]:
        """The ids of the registered images."""
        return set(self.model.reg_image_ids())

    def summary(self, folder: str) -> ComponentSummary:
        """The component for ``stage.json``; ``folder``: where its model is."""
        return ComponentSummary(
            photographs=sorted(self.model.image(i).name for i in self.photographs),
            num_points=int(self.model.num_points3D()),
            mean_reprojection_error_px=float(self.model.compute_mean_reprojection_error()),
            verdict=self.alone.grade,
            reasons=self.alone.reasons,
            folder=folder,
        )

    @property
    def alone(self) -> Verdict:
        """The verdict on the model whatever its share of the photographs is."""
        if self.verdict.grade == "good":
            return self.verdict
        return judge(self.evidence.model_copy(update={"total": self.evidence.registered}), 0.0)


@dataclass(frozen=True)
class Capture:
    """What models were mapped from.

    Attributes:
        database: The verified matches; not changed.
        total: The number of photographs of the scene.
        min_share: The share of registered images below which a model has failed.
        steps: The result of ``sequence_steps``.
        original: The database of all pairs, if pairs were left out of ``database``.
    """

    database: Path
    total: int
    min_share: float
    seed: int
    steps: tuple[Names, ...] = ()
    original: Path | None = None

    def judged(self, model: pycolmap.Reconstruction, before: Evidence | None = None) -> Component:
        """A model with its quality; ``before``: see ``collect_evidence``."""
        evidence = collect_evidence(
            model, self.database, self.total, self.steps, self.original, before
        )
        return Component(model, evidence, self.verdict(evidence))

    def verdict(self, evidence: Evidence) -> Verdict:
        """The verdict on a model of the capture."""
        return judge(evidence, self.min_share)

    def completed(
        self, main: Component, others: Sequence[pycolmap.Reconstruction]
    ) -> tuple[Component, list[pycolmap.Reconstruction], list[str]]:
        """Join other models and register further photographs, until neither adds any.

        Returns:
            The larger component, the models that hold photographs that it lacks, and the decisions.
        """
        decisions, grown, given = list[str](), True, main
        while grown:
            main, others, joints = self.with_joined(main, others)
            decisions += joints
            more, late = register_left_out(main.model, self.database, self.seed)
            if late:
                bundle_adjust(more, focal=False, distortion=False)
            found = self.judged(more) if late else main
            grown = bool(late) and found.alone.grade != "failed"
            if grown:
                main = found
                decisions.append(
                    f"registered in a second try, with fewer matches: {list_names(late)}"
                )
            grown = grown and bool(others)
        if main is not given and main.alone.grade == "good":
            model, last = adjust_last(main.model, self.database, cameras=False)
            main = self.judged(model)
            decisions.append(last)
        return main, list(others), decisions

    def with_joined(
        self, main: Component, others: Sequence[pycolmap.Reconstruction]
    ) -> tuple[Component, list[pycolmap.Reconstruction], list[str]]:
        """As ``completed``, by joining other models alone."""
        waiting, decisions, grown = list(others), list[str](), True
        while grown:
            grown = False
            for other in list(waiting):
                new = len(set(other.reg_image_ids()) - main.photographs)
                found = self._joined(main, other) if new else None
                if found:
                    main, joint = found
                    grown = True
                    decisions.append(
                        f"joined a model with {counted(new, 'further photograph')}: "
                        f"{counted(len(joint.links), 'pair')} of photographs agree on the joint"
                    )
                if found or not new:
                    waiting.remove(other)
            grown = grown and bool(waiting)
        return main, waiting, decisions

    def _joined(
        self, main: Component, other: pycolmap.Reconstruction
    ) -> tuple[Component, Joint] | None:
        """The component with the photographs of another model; None without a sound joint."""
        with pycolmap.Database.open(self.database) as opened:
            first, second = read_views(main.model, opened), read_views(other, opened)
            pairs = read_verified_pairs(opened)
        points = tuple({i: p.xyz for i, p in m.points3D.items()} for m in (main.model, other))
        joint = find_joint(first, second, (points[0], points[1]), pairs)
        if joint is None:
            return None
        joined = self.judged(join_models(main.model, other, joint, self.database))
        with pycolmap.Database.open(self.database) as opened:
            views = read_views(joined.model, opened)
        across = missing_covisibility(joined.model, views, second.keys() - first.keys())
        if across > MAX_MISSING_COVISIBILITY[0] or not _is_sound(joined, main, self.judged(other)):
            return None
        return joined, joint


def find_components(
    attempt: Attempt,
    capture: Capture,
    refine: Callable[[Component], tuple[Component, list[str]]],
) -> tuple[list[Component], list[str]]:
    """The components that an attempt found, and the decisions.

    The first component is the attempt's largest model, refined and complete, unless it failed by
    itself. The others follow by size: the attempt's own models, and those of other attempts that
    are not failed and most of whose photographs no component has.

    Args:
        refine: Adjusts the cameras of a component; returns it and the decisions.
    """
    if attempt.evidence is None:
        return [], []
    main = Component(attempt.models[0], attempt.evidence, attempt.verdict)
    rest, decisions = [*attempt.models[1:], *attempt.spare], list[str]()
    if main.alone.grade != "failed":
        main, decisions = refine(main)
        main, rest, more = capture.completed(main, rest)
        decisions += more
    components, known = [main], main.photographs
    rest.sort(key=lambda model: -model.num_reg_images())
    while rest:
        model, *rest = rest
        new = len(set(model.reg_image_ids()) - known)
        is_own = any(model is own for own in attempt.models)
        if not new or not (is_own or 2 * new >= model.num_reg_images()):
            continue
        component = capture.judged(model)
        if is_own or component.alone.grade != "failed":
            component, rest, more = capture.with_joined(component, rest)
            decisions += more
            components.append(component)
            known |= component.photographs
    return components, decisions


def _is_sound(joined: Component, main: Component, other: Component) -> bool:
    """Whether a joined model has all photographs and is not worse than its parts: joining must not
    fold look-alike places onto each other."""
    parts = [main.evidence, other.evidence]
    missing = max(MAX_MISSING_COVISIBILITY[1], *(part.missing_covisibility for part in parts))
    agreeing = min(MIN_AGREEING_PAIRS[1], *(part.agreeing_pairs for part in parts))
    return (
        joined.photographs >= main.photographs | other.photographs
        and GRADES.index(joined.alone.grade) >= GRADES.index(main.alone.grade)
        and joined.evidence.missing_covisibility <= missing
        and joined.evidence.agreeing_pairs >= agreeing
    )
