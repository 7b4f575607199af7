"""Projects whose training pauses, Snakemake in the background, and the jobs it submits to Slurm."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.slurm_cluster import Cluster
from tests.e2e.harness import TINY, copy_run, copy_sources, environment

T = TypeVar("T")

SCENE = "results/tiny/metrics.json"
TRAINING = "results/tiny/train/stage.json"
# The profile, with shorter intervals between two queries of the jobs' states.
SLURM = (
    *("--workflow-profile", "profiles/slurm"),
    *("--slurm-init-seconds-before-status-checks", "1", "--seconds-between-status-checks", "2"),
)
# What follows the stages that make the poses.
TRAINED = ("coarse", "partition", "train", "export", "evaluate", "coverage", "report")

# Training stops at a step, and uses memory, if the test demands it.
PAUSE = """
from pathlib import Path
import time
from pipeline.runtime import termination

def pause(step):
    while not termination.requested():
        try:
            if step < int(Path("pause").read_text()):
                return
            Path("paused.new").write_text(str(step))
            Path("paused.new").rename("paused")
            Path("allocate").unlink()
            memory = bytes([1]) * (2 << 30)
            time.sleep(600)
        except FileNotFoundError:
            if not Path("pause").exists():
                return
        time.sleep(0.1)
"""


def until(found: Callable[[], T], what: str, seconds: float = 600) -> T:
    """The first true value of ``found()``."""
    end = time.monotonic() + seconds
    while not (value := found()):
        assert time.monotonic() < end, f"not within {seconds:.0f} s: {what}"
        time.sleep(0.2)
    return value


def with_poses(finished: Path, folder: Path) -> Path:
    """A copy of a finished project that has yet to train."""
    copy_run(finished, folder)
    for stage in TRAINED:
        shutil.rmtree(folder / "results/tiny" / stage, ignore_errors=True)
    (folder / SCENE).unlink()
    return folder


def that_pauses(project: Path) -> Path:
    """Change a project so that its training saves a checkpoint after each step, and pauses at the
    step that the file ``pause`` names."""
    copy_sources(project)
    loop = project / "pipeline/training/loop"
    (loop / "pause.py").write_text(PAUSE)
    text = (loop / "session.py").read_text()
    asked = "        if termination.requested():"
    changed = text.replace("CHECKPOINT_SECONDS = 30.0", "CHECKPOINT_SECONDS = 0.0")
    assert changed != text and changed.count(asked) == 1
    changed = changed.replace(asked, f"        pause(state.step)\n{asked}")
    first = "from pipeline.training.loop.state import"
    changed = changed.replace(first, f"from pipeline.training.loop.pause import pause\n{first}")
    (loop / "session.py").write_text(changed)
    return project


class Running:
    """Snakemake, started in the background in a project."""

    started: list[Running] = []  # noqa: RUF012  (of all projects)

    def __init__(self, project: Path, target: str, *options: str, config: dict[str, Any] = TINY):
        self.project = project
        self.file = project / f"snakemake-{len(Running.started)}.txt"
        values = [f"{name}={json.dumps(value)}" for name, value in config.items()]
        with self.file.open("w") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "snakemake", target, *options, "--config", *values],
                cwd=project,
                env=environment(project),
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        Running.started.append(self)

    def text(self) -> str:
        return self.file.read_text()

    def log(self) -> str:
        """Snakemake's own messages, of all runs in the project."""
        files = sorted(self.project.glob(".snakemake/log/*.log"))
        return "".join(file.read_text() for file in files)

    def submitted(self) -> list[str]:
        """The ids of its Slurm jobs."""
        return re.findall(r"Slurm job (\d+)", self.text())

    def next_job(self, count: int) -> str:
        """The id of the job that is submitted after ``count`` others."""

        def found() -> str | None:
            assert self.process.poll() is None, f"snakemake has ended:\n{self.text()}"
            return dict(enumerate(self.submitted())).get(count)

        job = until(found, f"submission {count + 1} of {self.project.name}")
        assert job is not None
        return job

    def finish(self) -> str:
        """Its output, when it has ended without an error."""
        code = self.process.wait(900)
        assert code == 0, f"snakemake ended with {code}:\n{self.text()}"
        return self.text()


class Jobs:
    """What Slurm's controller reports about jobs."""

    def __init__(self, cluster: Cluster):
        self.cluster = cluster

    def record(self, job: str) -> dict[str, str]:
        """The fields of a job; none while the controller does not answer."""
        text = self.cluster.run("scontrol", "show", "job", "-o", job, check=False)
        pairs = (word.partition("=") for word in text.split())
        return {name: value for name, _, value in pairs}

    def field(self, job: str, name: str) -> str:
        return self.record(job).get(name, "")

    def of(self, project: Path, *options: str) -> list[str]:
        """The ids of a project's jobs: those in the queue, with ``-t all`` also the ended ones."""
        lines = self.cluster.run("squeue", "-h", *options, "-o", "%i|%Z").splitlines()
        rows = [line.split("|", 1) for line in lines]
        return sorted((job for job, folder in rows if Path(folder) == project), key=int)

    def ended(self, job: str) -> str:
        """The state of a job that has ended, when its processes have."""
        states = ("CANCELLED", "FAILED", "TIMEOUT", "OUT_OF_MEMORY", "COMPLETED")

        def found() -> str:
            state = self.field(job, "JobState")
            return state if state in states and job not in self.cluster.jobs() else ""

        return until(found, f"the end of job {job}")


class Training:
    """A stage of training in a project that pauses."""

    def __init__(self, project: Path, stage: str = "train"):
        self.project, self.stage = project, stage

    def pause_at(self, step: int) -> None:
        (self.project / "paused").unlink(missing_ok=True)
        (self.project / "pause.new").write_text(str(step))
        (self.project / "pause.new").rename(self.project / "pause")

    def go_on(self) -> None:
        (self.project / "pause").unlink()

    def use_memory(self) -> None:
        """Let the paused training allocate more memory than its job may use."""
        (self.project / "allocate").touch()

    def paused(self, job: str) -> int:
        """The step at which training pauses in a job."""
        file = self.project / "paused"
        until(lambda: file.exists(), f"the pause of training in job {job}:\n{self.log(job)}")
        return int(file.read_text())

    def log(self, job: str) -> str:
        """The output of a job that has not succeeded."""
        files = list((self.project / ".snakemake/slurm_logs").rglob(f"{job}.log"))
        return files[0].read_text(errors="replace") if files else ""

    def step_in(self, job: str, pattern: str) -> int:
        """The step that a line of the job's output names."""
        found = until(lambda: re.search(pattern, self.log(job)), f"{pattern} in job {job}")
        return int(found[1])

    def saved_by_sigterm(self, job: str) -> int:
        return self.step_in(job, r"stopped after (\d+) steps")

    def resumed_at(self, job: str) -> int:
        return self.step_in(job, r"training: resuming at (\d+)/")

    def checkpoint(self) -> int:
        """The step of the newest whole checkpoint."""
        folders = self.project.glob(f"results/tiny/.scratch/{self.stage}/*/checkpoints")
        names = [file.name for folder in folders for file in folder.glob("checkpoint_*.sha256")]
        return max(int(re.findall(r"\d+", name)[0]) for name in names)


def lose_power(cluster: Cluster, node: str, job: str) -> None:
    """Kill the daemon of a node and all processes of the job that it runs."""
    os.kill(int((cluster.folder / f"{node}.pid").read_text()), signal.SIGKILL)
    for process in Path("/proc").glob("[0-9]*"):
        try:
            command = (process / "cmdline").read_bytes()
            variables = (process / "environ").read_bytes().split(b"\0")
        except OSError:
            continue
        step = command.startswith(f"slurmstepd: [{job}.".encode())
        inside = f"SLURM_JOB_ID={job}".encode() in variables
        if step or (inside and b"SLURM_CLUSTER_NAME=test" in variables):
            try:
                os.kill(int(process.name), signal.SIGKILL)
            except ProcessLookupError:
                continue
