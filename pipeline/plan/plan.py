"""The plan of a scene: which stages run, why, and with which settings.

``make_plan`` is pure: the same scan, config and stages give the same plan. Each stage that runs is
a job of Snakemake; ``Plan.config`` are its settings.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence

from pipeline.config.schema import Config
from pipeline.io.posefiles import PoseSummary
from pipeline.plan.budget import training_memory_mb, typical_view
from pipeline.plan.panoramas import panorama_hints
from pipeline.plan.record import PlanRecord
from pipeline.plan.scan import Scan
from pipeline.plan.settle import PROCESSOR, Choice, gps_extent_m, settle
from pipeline.plan.stage import StageSpec
from pipeline.plan.stage_memory import memory_warnings
from pipeline.plan.summary import found
from pipeline.plan.values import Plan, SceneFacts

# The maximum length of lists in the plan, which is passed on command lines.
MAX_LISTED = 20


def make_plan(
    scan: Scan,
    config: Config,
    stages: Mapping[str, StageSpec],
    folder: str = "",
    device: Choice = PROCESSOR,
) -> Plan:
    """Decide which of ``stages`` a scene needs, and settle its options.

    Args:
        device: The machine's device, for ``train.device: auto``.

    Raises:
        UserError: See ``settle`` and the stages' ``decide``.
    """
    scan = scan.with_frames(config.video.max_frames)
    settled = settle(scan, config, device)
    decided = {name: spec.decide(scan, settled) for name, spec in stages.items()}
    running = {name for name, stage in decided.items() if stage.run}
    for name in running:
        sources = sorted(set(_upstream(stages[name], running, settled.config).values()))
        decided[name] = decided[name].model_copy(update={"inputs": sources})
    hints = panorama_hints(scan.maybe_panoramas, config) if scan.poses is None else []
    plan = Plan(
        scene=scan.manifest.scene,
        stages=decided,
        warnings=[],
        config=settled.config,
        facts=_facts(scan, settled.config),
        folder=folder,
    )
    warnings = _shortened([*memory_warnings(plan), *hints, *scan.warnings])
    return plan.model_copy(update={"warnings": warnings})


def upstream(spec: StageSpec, plan: Plan) -> dict[str, str]:
    """The stage that provides each input according to the plan, by the input's role."""
    running = {name for name, stage in plan.stages.items() if stage.run}
    return _upstream(spec, running, plan.config)


def _upstream(spec: StageSpec, running: Collection[str], config: Config) -> dict[str, str]:
    found = {}
    for role, candidates in spec.inputs.items():
        if role in spec.only_if and not spec.only_if[role](config):
            continue
        providers = [name for name in candidates if name in running]
        if providers or role not in spec.optional:
            found[role] = providers[0]
    return found


def input_folders(spec: StageSpec, plan: Plan) -> dict[str, str]:
    """The folder in ``results/<scene>/`` of each input, by the input's role. An input from a stage
    with several jobs has a role for each job, which ends in the job's number."""
    found = {}
    for role, stage in upstream(spec, plan).items():
        folders = plan.stages[stage].folders(stage)
        if len(folders) == 1:
            found[role] = folders[0]
        else:
            found |= {f"{role}_{job}": name for job, name in enumerate(folders, 1)}
    return found


def plan_record(plan: Plan) -> PlanRecord:
    """The content of ``plan.json``."""
    return PlanRecord(
        scene=plan.scene,
        stages=plan.stages,
        order=list(plan.stages),
        warnings=plan.warnings,
        facts=plan.facts,
    )


def describe(plan: Plan, *, full: bool = True, finished: Collection[str] = ()) -> str:
    """The plan for the terminal: the stages that run, and the skipped stages.

    Args:
        full: Whether the stages' decisions and the reasons for skipping stages are listed.
        finished: Stages that have a result, and are listed by name alone.
    """
    lines = [f"{plan.scene}: {found(plan.facts)}"]
    skipped: dict[str, list[str]] = {}
    if finished:
        named = [name for name in plan.stages if name in finished]
        lines.append(f"  finished: {', '.join(named)}")
    for name, stage in plan.stages.items():
        if stage.run and name in finished:
            continue
        if stage.run:
            lines.append(f"  {name:<10} {stage.reason}")
            lines += [f"  {'':<10} - {decision}" for decision in stage.decisions if full]
        else:
            skipped.setdefault(stage.reason, []).append(name)
    if skipped:
        grouped = [
            ", ".join(names) + (f" ({reason})" if full else "") for reason, names in skipped.items()
        ]
        lines.append(f"  skipped: {('; ' if full else ', ').join(grouped)}")
    lines += [f"  warning: {warning}" for warning in plan.warnings]
    return "\n".join(lines)


def _shortened(warnings: Sequence[str]) -> list[str]:
    """The first warnings and the number of further ones; the inspect stage reports all."""
    rest = len(warnings) - MAX_LISTED
    further = [f"and {rest} further warnings"] if rest > 0 else []
    return [*warnings[:MAX_LISTED], *further]


def _most_frequent(counts: Counter[str]) -> dict[str, int]:
    """The most frequent values with their counts; "others" counts the rest."""
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    rest = sum(count for _, count in ordered[MAX_LISTED:])
    return dict(ordered[:MAX_LISTED]) | ({"others": rest} if rest else {})


def _facts(scan: Scan, config: Config) -> SceneFacts:
    photos = scan.planned
    sizes = Counter(f"{photo.width}x{photo.height}" for photo in photos)
    groups = Counter(photo.camera_group for photo in photos)
    poses = scan.poses
    return SceneFacts(
        photographs=len(scan.photos),
        videos=len(scan.videos),
        max_frames=len(scan.frames),
        video_frames=sum(video.frames for video in scan.videos),
        linear=scan.num_linear,
        panoramas=scan.num_panoramas,
        alpha=scan.num_alpha,
        masks=scan.num_masks,
        depths=scan.num_depths,
        gps=scan.num_gps,
        ground_control=scan.ground_control is not None,
        point_cloud=scan.cloud,
        gps_extent_m=round(gps_extent_m(scan), 1),
        focal_priors=scan.num_focal,
        turned_by_exif=sum(photo.orientation != 1 for photo in photos),
        bits=max(photo.bits for photo in photos),
        sizes=_most_frequent(sizes),
        camera_groups=_most_frequent(groups),
        ordered=scan.ordered,
        image_folder=scan.image_folder,
        view_size=typical_view(scan, config),
        training_memory_mb=training_memory_mb(scan, config),
        given_poses=poses
        and PoseSummary.model_validate(poses.model_dump(exclude={"names", "splits", "lost"})),
        published_scene=scan.published,
        truth="sparse_gt" if scan.truth is not None else None,
        truth_digest=scan.truth_digest,
        fingerprint=scan.fingerprint,
    )
