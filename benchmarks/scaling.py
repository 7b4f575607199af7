"""How the jobs of a scene grow with its photographs: CPU time, memory and files by stage.

    python -m benchmarks.scaling results town125@grow125 town1000@grow1000

Runs are folders of results, from few photographs to many. Stages that have not finished are left
out. ``--stages block polish`` lists these stages alone: how a block grows.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Sequence
from pathlib import Path

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.record_tables import scaling_table
from benchmarks.results import ScalingResult
from pipeline.plan.record import read_plan
from pipeline.runtime.record import RUN, read_run

# Step -> its stages. One of them does the step alone in a scene of few photographs.
STEPS = {
    "features": ("extract", "features"),
    "matches": ("pairs", "match", "matches"),
    "training": ("coarse", "partition", "block", "polish", "train"),
}


def stage_results(folder: Path, only: Collection[str] = ()) -> list[ScalingResult]:
    """The finished stages of a run: those in ``only``, or all, with those of ``STEPS`` together."""
    plan = read_plan(folder)
    step_of = {stage: step for step, stages in STEPS.items() for stage in stages if not only}
    found: dict[str, list[Path]] = {}
    for stage in filter(plan.runs, plan.order):
        if only and stage not in only:
            continue
        jobs = [folder / name for name in plan.stages[stage].folders(stage)]
        found.setdefault(step_of.get(stage, stage), []).extend(jobs)
    return [
        _result(folder.name, plan.facts.photographs, step, jobs)
        for step, jobs in found.items()
        if all((job / RUN).exists() for job in jobs)
    ]


def _result(run: str, photographs: int, stage: str, jobs: Sequence[Path]) -> ScalingResult:
    runs = [read_run(job) for job in jobs]
    files = [file for job in jobs for file in job.rglob("*") if file.is_file()]
    return ScalingResult(
        run=run,
        photographs=photographs,
        stage=stage,
        jobs=len(jobs),
        cpu_s=sum(run.cpu_s for run in runs),
        largest_cpu_s=max(run.cpu_s for run in runs),
        peak_rss_mb=max(run.peak_rss_mb for run in runs),
        output_mb=sum(file.stat().st_size for file in files) / 1e6,
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scaling", description=__doc__)
    parser.add_argument("results", type=Path, help="folder of results")
    parser.add_argument("runs", nargs="+", metavar="RUN", help="from few photographs to many")
    parser.add_argument(
        "--stages", nargs="+", default=[], metavar="STAGE", help="these stages alone"
    )
    add_record_options(parser)
    options = parser.parse_args(arguments)
    found = [
        result
        for run in options.runs
        for result in stage_results(options.results / run, options.stages)
    ]
    print(scaling_table(found))
    if options.json is not None:
        write_record(options.json, measured("scaling", options.note, arguments), found)


if __name__ == "__main__":
    main()
