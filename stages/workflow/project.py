"""The interface of the Snakefile: scenes, their plans, and the inputs and key of each rule."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from pipeline.config.config_file import check_config_file
from pipeline.config.load import load_project, scene_config
from pipeline.config.runs import Run, all_runs, name_fault, parse_run
from pipeline.config.schema import Config
from pipeline.plan import duration, stage_memory
from pipeline.plan.keys import stage_key, uses_gpu
from pipeline.plan.plan import input_folders, make_plan, plan_record
from pipeline.plan.scan import scan
from pipeline.plan.settle import PROCESSOR, Choice
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import Plan
from pipeline.render.devices import check_device, choose_device
from pipeline.reporting.acceptance.command import read_criteria
from pipeline.reporting.batch import PUBLISHED
from pipeline.reporting.headline import batch_lines
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import EXIT_INTERRUPTED, UserError, as_user_error
from pipeline.runtime.layout import PACKAGES, SCAN_CACHE, STAGE_OUTPUT
from pipeline.runtime.lock import check_not_locked, lock_run, user_name
from pipeline.runtime.record import (
    STAGE,
    canonical,
    file_digest,
    is_current,
    missing_output,
    read_stage,
)
from pipeline.runtime.source import stage_source_hash
from stages.workflow.cluster import (
    DEFAULT_CPUS,
    OVERHEAD_MB,
    compile_for_all_nodes,
    granted_cpus,
    granted_memory_mb,
    group_of,
    largest_node,
    wait_for_earlier_jobs,
)
from stages.workflow.display import RunDisplay, show_run
from stages.workflow.failures import exit_with, reporting_errors
from stages.workflow.folders import RESULTS, check_working_directory, check_writable
from stages.workflow.internals import Flow, use_locks_of_runs
from stages.workflow.outcomes import failed_job, outcome, was_made
from stages.workflow.registry import STAGES

# Written when runs of a batch failed. From then on it is an input of the tables, so that these are
# made again after the next batch.
FAILURES = RESULTS / ".failures.json"


def check_config(path: str) -> None:
    """End Snakemake with one message if it cannot read this configuration file."""
    try:
        check_config_file(Path(path))
    except UserError as error:
        exit_with(error)


# Factor of the memory of a job that is tried again.
MORE_MEMORY = 1.5


class SnakemakeProject:
    """Binds scenes, their options and their plans to Snakemake's input functions.

    The wildcard ``scene`` is the name of a run: a scene, alone or with a configuration and a seed
    (see ``pipeline.config.runs``).

    Args:
        raw: Snakemake's ``config``.
        workflow: Snakemake's ``workflow``.
        display: The display of this run.

    Raises:
        UserError: the configuration is not valid, before any job starts.
    """

    def __init__(self, raw: Mapping[str, Any], workflow: Any, display: RunDisplay | None = None):
        self._raw = dict(raw)
        self._flow = Flow(workflow)
        self._started = time.time()
        # Snakemake and packages end with a traceback if the user has no name.
        os.environ.setdefault("LOGNAME", user_name())
        try:
            check_working_directory()
            use_locks_of_runs()
            self._project, named = load_project(self._raw)
        except UserError as error:
            exit_with(error)
        self._display = display or show_run(workflow)
        self._root = self._display.data_root = Path(self._project.data_root)
        for name in named:
            if name_fault(name) or not (self._root / name).is_dir():
                print(f"warning: scenes.{name}: no such folder in data_root", file=sys.stderr)
        self._make_plan = cache(self._scan_and_plan)
        self._lost: set[Path] = set()
        # Not set in the rules' commands, which Snakemake compares: moving the project or its
        # virtual environment must not rerun anything.
        os.environ["PYTHONPATH"] = os.pathsep.join(
            filter(None, [self._flow.folder, os.environ.get("PYTHONPATH", "")])
        )
        os.environ["PATH"] = os.pathsep.join(
            [str(Path(sys.executable).parent), os.environ.get("PATH", "")]
        )
        if self._flow.is_shown and not self._flow.is_verbose:
            os.environ[STAGE_OUTPUT] = "log"
        else:
            os.environ.pop(STAGE_OUTPUT, None)
        # OpenMP threads that wait actively slow down other processes.
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")

    # --- one scene ------------------------------------------------------------------------

    @property
    def stages(self) -> Iterable[StageSpec]:
        """The declarations of all stages, in the order of the DAG."""
        return STAGES.values()

    def folder(self, spec: StageSpec) -> str:
        """The stage's folder in ``results/<scene>/``, with a wildcard if it has several jobs."""
        return f"{spec.name}_{{job}}" if spec.scattered else spec.name

    def packaged(self, file: str) -> str:
        """The absolute path of a file of the packages, which are not in the Snakefile's folder if
        the program is installed."""
        return str(PACKAGES / file)

    def inputs(self, spec: StageSpec) -> Callable[[Any], dict[str, str]]:
        """Input function: role -> ``stage.json`` of the stage that provides it, and ``plan.json``
        for stages that read the plan."""

        def files(wildcards: Any) -> dict[str, str]:
            self._run_if_outdated(spec, wildcards)
            sources = self._inputs(spec, wildcards.scene)
            found = {role: str(folder / "stage.json") for role, folder in sources.items()}
            if spec.shows_plan:
                found["plan"] = str(RESULTS / wildcards.scene / "plan.json")
            return found

        return files

    def _run_if_outdated(self, spec: StageSpec, wildcards: Any) -> None:
        """Run a stage whose output is missing, or whose record has another key. Snakemake evaluates
        the stage's input function, which calls this, before it decides which jobs run.

        Snakemake does not make an intermediate file again if the results that follow from it
        exist. It compares keys with records of its own, in .snakemake, which a copied folder of
        results does not have.
        """
        if not self._flow.decides_jobs:
            return
        folder = RESULTS / wildcards.scene / self.folder(spec).format_map(wildcards)
        if lost := missing_output(folder):
            self._flow.force(folder / STAGE)
            # What has no record has not been made yet, or is being made again: Snakemake deletes
            # the record first.
            if folder not in self._lost and lost.name != STAGE and was_made(folder, spec.name):
                self._lost.add(folder)
                print(f"{lost} is missing: {folder.name} runs again", file=sys.stderr)
            return
        if not self._flow.compares_keys:
            return
        try:
            current = canonical(read_stage(folder).key) == self.key(spec)(wildcards)
        except UserError:  # The stage that reads the record has a message.
            return
        if not current:
            self._flow.force(folder / STAGE)

    def folders(self, spec: StageSpec) -> Callable[[Any], list[str]]:
        """Params function: "role=folder" for the stage's command line."""
        return lambda wildcards: [
            f"{role}={folder}" for role, folder in self._inputs(spec, wildcards.scene).items()
        ]

    def published(self, spec: StageSpec) -> Callable[[Any], list[str]]:
        """Params function: "file=path" for outputs that are copied to the scene's folder."""
        return lambda wildcards: [
            f"{name}={RESULTS / wildcards.scene / name}" for name in spec.publishes
        ]

    def key(self, spec: StageSpec) -> Callable[[Any], str]:
        """Params function: the stage's key."""
        return lambda wildcards: stage_key(
            spec, self._plan(wildcards.scene), int(wildcards.job) if spec.scattered else 1
        )

    def threads(self, spec: StageSpec) -> Callable[[Any], int]:
        """Threads function: the cores of this machine that Snakemake may use; on a cluster those of
        a node; in a job those of the job. Fewer where the memory is limited."""
        return lambda wildcards: stage_memory.threads_within(
            spec.name, self._plan(wildcards.scene), self._cores()
        )

    def _cores(self) -> int:
        limit = self._flow.cores_option or DEFAULT_CPUS
        if self._flow.in_job:
            # Snakemake gives the job all cores of the node.
            return granted_cpus() or min(limit, DEFAULT_CPUS)
        if not self._flow.submits_jobs:
            return self._flow.cores
        node = largest_node()
        return limit if node is None else min(limit, node.cpus)

    def group(self, spec: StageSpec) -> Callable[[Any], str | None]:
        """Group function: the group of jobs that a cluster runs as one, if there is a cluster."""

        def name(wildcards: Any) -> str | None:
            if not (self._flow.in_job or self._flow.submits_jobs):
                return None
            return group_of(spec.name, self._plan(wildcards.scene))

        return name

    def memory_mb(self, spec: StageSpec) -> Callable[[Any, int, int], int]:
        """Resources function: memory in MB that the stage may use, and what a cluster's job needs
        besides, but no more than a node has. A job that is tried again gets more: the last may have
        been killed for memory."""

        def megabytes(wildcards: Any, threads: int, attempt: int) -> int:
            estimate = stage_memory.memory_mb(spec.name, self._plan(wildcards.scene), threads)
            needed = round(estimate * MORE_MEMORY ** (attempt - 1))
            if self._flow.in_job:
                most = granted_memory_mb()
            elif self._flow.submits_jobs:
                node = largest_node()
                most = None if node is None else node.memory_mb
            else:
                return needed
            wanted = needed + OVERHEAD_MB
            return wanted if most is None else min(wanted, most)

        return megabytes

    def minutes(self, spec: StageSpec) -> Callable[[Any, int], int]:
        """Resources function: time limit of the stage's job on a cluster."""
        return lambda wildcards, attempt: (
            attempt * duration.minutes(spec.name, self._plan(wildcards.scene))
        )

    def gpus(self, spec: StageSpec) -> Callable[[Any], int]:
        """Resources function: the number of GPUs that the stage's job computes on."""
        return lambda wildcards: int(uses_gpu(spec, self._plan(wildcards.scene)))

    def plan(self, wildcards: Any) -> str:
        """Params function: the plan as canonical JSON."""
        return canonical(plan_record(self._plan(wildcards.scene)).model_dump(mode="json"))

    def acceptance(self, wildcards: Any) -> str:
        """Params function: the rules for the run's result, as canonical JSON."""
        chosen = self._plan(wildcards.scene).config.acceptance
        criteria = read_criteria(None if chosen is None else Path(chosen))
        return canonical(criteria.model_dump(mode="json"))

    def _inputs(self, spec: StageSpec, name: str) -> dict[str, Path]:
        return _sources(spec, self._plan(name), name)

    def _plan(self, name: str) -> Plan:
        """The run's plan; a UserError ends Snakemake."""
        try:
            # A run of another user is named before the missing permission to write.
            if self._flow.runs_jobs:
                check_not_locked(RESULTS / name)
            return self._make_plan(name)
        except UserError as error:
            exit_with(error)

    def _scan_and_plan(self, name: str) -> Plan:
        self._check_results(name)
        run = parse_run(name, self._project.configs, self._scenes)
        config = scene_config(self._raw, run.scene, run.config, run.seed)
        folder = self._root / run.scene
        found = scan(folder, run.scene, config, cache=RESULTS / name / SCAN_CACHE)
        plan = make_plan(found, config, STAGES, str(folder), self._device(config))
        if not self._is_on_cluster() and self._will_use_gpu(plan, name):
            check_device(config.train.device)
        plan = plan.model_copy(update={"scene": name})
        self._display.planned(plan)
        return plan

    def _device(self, config: Config) -> Choice:
        """The device for ``train.device: auto``. On a cluster, a plan must be the same on every
        node: there, a GPU is used only if the option names it, and the job that trains checks that
        its node has it."""
        if self._is_on_cluster() or config.train.device != "auto":
            return PROCESSOR
        chosen = choose_device()
        return chosen.device, chosen.reason

    def _is_on_cluster(self) -> bool:
        return self._flow.in_job or self._flow.submits_jobs or "SLURM_JOB_ID" in os.environ

    def _will_use_gpu(self, plan: Plan, name: str) -> bool:
        """Whether a stage that computes on a GPU has no current result."""
        return any(
            uses_gpu(STAGES[stage], plan) and self._outdated_job(plan, name, stage) is not None
            for stage in filter(plan.runs, plan.stages)
        )

    def _outdated_job(self, plan: Plan, name: str, stage: str) -> str | None:
        """The first folder of the stage's jobs without a current result; None if all have one."""
        spec = STAGES[stage]
        sources = _sources(spec, plan, name)
        for job, folder in enumerate(plan.stages[stage].folders(stage), 1):
            if not is_current(RESULTS / name / folder, stage_key(spec, plan, job), sources):
                return folder
        return None

    def _check_results(self, name: str) -> None:
        """Check that the run can have a folder of results: otherwise Snakemake would end with an
        error of its own, and other scenes of the batch with it."""
        fault = name_fault(name)
        if fault is not None:
            what = f"the name of a scene or of a run cannot be used: {fault}"
            shown = ascii(name) if len(name) <= 80 else ascii(f"{name[:80]}...")
            raise UserError(what, file=self._root / shown[1:-1], fix="rename it")
        folder = RESULTS / name
        if not (folder / "metrics.json").exists():  # Else nothing may be left to write.
            check_writable(folder)

    # --- batches --------------------------------------------------------------------------

    @cached_property
    def _scenes(self) -> list[str]:
        try:
            folders = [path for path in self._root.glob("*") if os.path.isdir(path)]
        except OSError as error:
            fix = "give yourself the permission to read it, or set data_root to another folder"
            exit_with(UserError(f"cannot be read: {error.strerror}", file=self._root, fix=fix))
        return sorted(path.name for path in folders if path.name[0] not in "._")

    @cached_property
    def _batch(self) -> tuple[list[Run], dict[Run, str]]:
        """All runs (scenes x configurations x seeds), and run -> reason for those that cannot be
        planned, because their folder is not a scene."""
        left_out: dict[Run, str] = {}
        runs = all_runs(self._scenes, self._project.configs, self._project.seeds)
        for run in runs:
            try:
                self._make_plan(run.name)
            except UserError as error:
                left_out[run] = str(error)
        for message in dict.fromkeys(left_out.values()):
            print(f"left out: {message}", file=sys.stderr)
        if len(left_out) == len(runs):
            fix = "set data_root to the folder whose subfolders are scenes"
            exit_with(UserError("expected scene folders, found none", file=self._root, fix=fix))
        return runs, left_out

    def every_run(self, wildcards: Any) -> list[str]:
        """Input function: the published files of all runs. Snakemake makes a deleted file again
        only if it is asked for."""
        runs, left_out = self._batch
        targets = [
            str(RESULTS / run.name / file)
            for run in runs
            if run not in left_out
            for spec in STAGES.values()
            for file in spec.publishes
        ]
        return [*targets, str(FAILURES)] if FAILURES.exists() else targets

    def outcomes(self, wildcards: Any) -> str:
        """Params function: the outcomes of all runs, when none has failed."""
        runs, left_out = self._batch
        return canonical(
            {
                "source": stage_source_hash("stages.workflow.batch"),
                "published": file_digest(PUBLISHED),
                "outcomes": [outcome(run, left_out.get(run)) for run in runs],
            }
        )

    # --- before and after the jobs --------------------------------------------------------

    def before_jobs(self) -> None:
        """Check that the folders of results can be written, and lock them. On a cluster, compile
        the native libraries before jobs are submitted: a compiler takes more memory than a job may
        use, and nodes may have none."""
        needed = self._flow.needed_jobs()
        # The tables of a batch are in the folder of all results.
        written = {RESULTS / getattr(job.wildcards, "scene", "") for job in needed if job.output}
        for folder in sorted(written):
            try:
                check_writable(folder)
                lock_run(folder)
            except UserError as error:
                exit_with(error)
            except OSError as error:
                error.filename = error.filename or str(folder)
                exit_with(as_user_error(error) or UserError(f"{error}", file=folder))
        self._flow.unlimit_rate()
        if self._flow.submits_jobs:
            self._flow.watch(needed)
            wait_for_earlier_jobs(Path.cwd())
            compile_for_all_nodes()
        self._display.start()

    def after_success(self) -> None:
        """Show the results."""
        self._display.succeeded()

    def after_failure(self) -> None:
        """Show where the run was stopped, or what is kept after errors, and write a batch's tables
        with the runs that succeeded."""
        if self._display.interrupted():
            raise SystemExit(EXIT_INTERRUPTED)
        self._display.failed()
        if "_batch" in self.__dict__:  # Computed only if the target needs all runs.
            runs, left_out = self._batch
            outcomes = [
                outcome(run, left_out[run]) if run in left_out else self._ended(run) for run in runs
            ]
            command = [sys.executable, "-m", "stages.workflow.batch", "--results", str(RESULTS)]
            text = canonical({"outcomes": outcomes})
            subprocess.run([*command, "--outcomes", "-"], input=text, text=True, check=False)
            lost = [ended for ended in outcomes if ended["status"] != "ok"]
            with reporting_errors("the batch's tables"):
                write_json(FAILURES, {"at": self._started, "lost": lost})
            self._display.message("\n".join(batch_lines(RESULTS)))

    def _ended(self, run: Run) -> dict[str, Any]:
        """The outcome of a run of the batch."""
        plan = self._make_plan(run.name)
        for stage in filter(plan.runs, plan.stages):
            job = self._outdated_job(plan, run.name, stage)
            if job is None:
                continue
            log = RESULTS / run.name / "logs" / f"{job}.log"
            return failed_job(run, stage, log, self._started)
        return outcome(run, None)


def _sources(spec: StageSpec, plan: Plan, name: str) -> dict[str, Path]:
    """Role of the stage's input -> its folder."""
    return {role: RESULTS / name / source for role, source in input_folders(spec, plan).items()}
