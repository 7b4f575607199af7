"""Faults of a Slurm cluster, on a real one of two nodes with one core each: after each, the
results have the bits of an undisturbed run on one machine."""

from __future__ import annotations

import re
import shutil
import signal
import tempfile
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks import slurm_cluster
from benchmarks.slurm_cluster import Cluster
from pipeline.training.loop.session import CHECKPOINT_SECONDS
from tests.cluster.runs import (
    SCENE,
    SLURM,
    TRAINING,
    Jobs,
    Running,
    Training,
    lose_power,
    that_pauses,
    until,
    with_poses,
)
from tests.e2e import transcripts
from tests.e2e.harness import (
    TINY,
    copy_run,
    make_project,
    make_scene,
    metrics,
    model_digests,
    snakemake,
)
from tests.tools import need, need_package, unsupported

BLOCKS = TINY | {"partition": {"blocks": 2}}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    need_package("snakemake-executor-plugin-slurm")
    need(*slurm_cluster.PROGRAMS)
    if missing := slurm_cluster.missing_programs():
        unsupported(f"a Slurm cluster needs {', '.join(missing)}")
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))  # sockets' paths must be short
    try:
        with slurm_cluster.running(folder) as found:
            try:
                yield found
            finally:
                for run in Running.started:
                    run.process.kill()
                    run.process.wait()
                found.run("scancel", "--user=root", check=False)
                until(lambda: not found.jobs(), "the end of all jobs")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory, cluster: Cluster) -> Path:
    """A project with photographs and no results."""
    project = make_project(tmp_path_factory.mktemp("cluster") / "scene")
    make_scene(project, "tiny")
    return project


@pytest.fixture(scope="module")
def undisturbed(scene: Path, cluster: Cluster) -> Running:
    """A whole scene on the cluster, which runs beside the next fixtures. Its jobs may have more
    cores than a node has."""
    project = copy_run(scene, scene.with_name("undisturbed"))
    return Running(project, SCENE, *SLURM, "--cores", "16")


@pytest.fixture(scope="module")
def reference(scene: Path, undisturbed: Running) -> Path:
    """The results of one machine."""
    project = copy_run(scene, scene.with_name("reference"))
    snakemake(project, SCENE, config=TINY)
    return project


@pytest.fixture(scope="module")
def local_blocks(scene: Path, reference: Path) -> Future[Path]:
    """The training of a scene in blocks on one machine, beside other fixtures."""

    def train() -> Path:
        project = with_poses(reference, scene.with_name("blocks"))
        snakemake(project, TRAINING, config=BLOCKS)
        return project

    return ThreadPoolExecutor(1).submit(train)


def trained(project: Path) -> dict[str, str]:
    """Digests of the results of training."""
    digests = model_digests(project, "tiny")
    return {name: digests[name] for name in ("train/gaussians.npz", "train/curve.json")}


# --- training that is ended -------------------------------------------------------------------


@dataclass(frozen=True)
class End:
    """How a job's training ended, and how the next one began.

    Attributes:
        state: of the job that ended.
        saved: step of the last checkpoint.
        resumed: step at which the next training began.
    """

    state: str
    saved: int
    resumed: int


@dataclass(frozen=True)
class Interrupted:
    """One training that three faults ended."""

    project: Path
    run: Running
    cancelled: End
    timed_out: End
    node_down: End
    restarts: str


@pytest.fixture(scope="module")
def interrupted(
    scene: Path, reference: Path, local_blocks: Future[Path], cluster: Cluster
) -> Interrupted:
    project = that_pauses(with_poses(reference, scene.with_name("interrupted")))
    jobs, training = Jobs(cluster), Training(project)
    training.pause_at(50)
    run = Running(project, TRAINING, *SLURM)

    first = run.next_job(0)
    assert training.paused(first) == 50
    cluster.run("scancel", first)
    state = jobs.ended(first)
    training.pause_at(100)
    saved = training.saved_by_sigterm(first)

    second = run.next_job(1)
    assert training.paused(second) == 100
    cancelled = End(state, saved, training.resumed_at(second))
    # Time limits are in minutes; the end of a running job is a time.
    cluster.run("scontrol", "update", f"JobId={second}", "EndTime=now+1")
    state = jobs.ended(second)
    training.pause_at(150)
    saved = training.saved_by_sigterm(second)

    third = run.next_job(2)
    assert training.paused(third) == 150
    timed_out = End(state, saved, training.resumed_at(third))
    node = jobs.field(third, "NodeList")
    lose_power(cluster, node, third)
    saved = training.checkpoint()
    training.pause_at(200)
    until(lambda: jobs.field(third, "Restarts") == "1", f"the return of job {third} to the queue")
    state = cluster.run("sinfo", "-h", "-n", node, "-o", "%T").strip()
    cluster.start_node(node)
    training.paused(third)
    node_down = End(state, saved, training.resumed_at(third))
    training.go_on()
    run.finish()
    restarts = jobs.field(third, "Restarts")
    return Interrupted(project, run, cancelled, timed_out, node_down, restarts)


def test_a_cancelled_job_goes_on_from_its_checkpoint(interrupted: Interrupted) -> None:
    assert interrupted.cancelled == End("CANCELLED", 50, 50)


def test_a_time_limit_goes_on_from_its_checkpoint(interrupted: Interrupted) -> None:
    assert interrupted.timed_out == End("TIMEOUT", 100, 100)


def test_a_job_of_a_lost_node_goes_on_from_its_last_checkpoint(interrupted: Interrupted) -> None:
    """Slurm starts the same job again: it counts as no attempt."""
    found = interrupted.node_down
    assert found.state.rstrip("*") == "down"
    assert 100 <= found.resumed == found.saved <= 150
    assert interrupted.restarts == "1"
    assert len(interrupted.run.submitted()) == 3, "three attempts"


def test_a_checkpoint_is_never_older_than_a_minute() -> None:
    assert CHECKPOINT_SECONDS <= 60


def test_interrupted_training_gives_the_same_bits(
    interrupted: Interrupted, reference: Path
) -> None:
    assert trained(interrupted.project) == trained(reference)


def test_an_undisturbed_scene_is_three_jobs(
    undisturbed: Running, reference: Path, cluster: Cluster
) -> None:
    """Grouped stages: a scene does not queue for each of its eleven stages."""
    said = re.sub(r"^  submitted .*\n", "", undisturbed.finish(), flags=re.M)
    transcripts.check("cluster", said, lines=37)
    assert len(undisturbed.submitted()) == 3
    assert Jobs(cluster).of(undisturbed.project, "-t", "all") == undisturbed.submitted()
    assert metrics(undisturbed.project, "tiny") == metrics(reference, "tiny")
    assert model_digests(undisturbed.project, "tiny") == model_digests(reference, "tiny")


def test_jobs_ask_for_no_more_cores_than_a_node_has(undisturbed: Running, cluster: Cluster) -> None:
    """Slurm accepts such a job, and never starts it."""
    undisturbed.finish()
    jobs = Jobs(cluster)
    assert {jobs.field(job, "NumCPUs") for job in undisturbed.submitted()} == {"1"}


# --- Snakemake, the controller, other runs and blocks -----------------------------------------


@dataclass(frozen=True)
class Abandoned:
    """A scene in blocks whose first training was killed for memory, then its Snakemake.

    Attributes:
        killed, next_memory: the state of the job that used too much memory; megabytes of it and
            of the next attempt.
        resumed: step at which the next attempt began.
        restarted: id, state and number of restarts of the running job after the controller's
            restart; those before it.
        other: exit code and output of another run with the same results, and its jobs.
        queued: the jobs in the queue while the new Snakemake waits.
        old: the job that the killed Snakemake has left.
        second: the new Snakemake.
    """

    project: Path
    killed: str
    memory: tuple[int, int]
    resumed: int
    restarted: list[tuple[str, ...]]
    other: tuple[int, str, list[str]]
    queued: list[str]
    old: str
    second: Running


@pytest.fixture(scope="module")
def abandoned(
    scene: Path, reference: Path, undisturbed: Running, local_blocks: Future[Path], cluster: Cluster
) -> Abandoned:
    """In the training of the whole scene, which precedes that of blocks. The blocks need both
    nodes."""
    undisturbed.finish()
    cluster.wait_until_idle()
    project = that_pauses(with_poses(reference, scene.with_name("abandoned")))
    jobs, training = Jobs(cluster), Training(project, "coarse")
    training.pause_at(15)
    run = Running(project, TRAINING, *SLURM, config=BLOCKS)
    first = run.next_job(0)
    training.paused(first)
    training.use_memory()
    killed = jobs.ended(first)
    training.pause_at(30)
    saved = training.checkpoint()
    old = run.next_job(1)
    training.paused(old)
    resumed = training.resumed_at(old)
    assert resumed == saved
    memory = tuple(int(jobs.field(job, "MinMemoryNode").rstrip("M")) for job in (first, old))

    restarted = [tuple(jobs.field(old, name) for name in ("JobId", "JobState", "Restarts"))]
    cluster.stop_controller()
    # Without an answer, Snakemake's executor tries accounting, and again at the next check.
    query = "Falling back to 'sacct'"
    until(lambda: run.log().count(query) >= 2, "a second status query without the controller")
    cluster.start_controller()
    until(lambda: jobs.field(old, "JobState") == "RUNNING", "the job after the controller's start")
    restarted += [tuple(jobs.field(old, name) for name in ("JobId", "JobState", "Restarts"))]

    folder = make_project(scene.with_name("other"))
    for name in ("data", "results"):
        (folder / name).symlink_to(project / name)
    other = Running(folder, TRAINING, *SLURM, config=BLOCKS)
    code = other.process.wait(300)

    run.process.send_signal(signal.SIGKILL)
    run.process.wait()
    second = Running(project, TRAINING, *SLURM, config=BLOCKS)
    until(lambda: "jobs of an earlier run" in second.text(), "the message about the old job")
    queued = jobs.of(project)
    training.go_on()
    second.finish()
    said = other.text()
    return Abandoned(
        project=project,
        killed=killed,
        memory=(memory[0], memory[1]),
        resumed=resumed,
        restarted=restarted,
        other=(code, said, jobs.of(folder, "-t", "all")),
        queued=queued,
        old=old,
        second=second,
    )


def test_a_job_killed_for_memory_gets_more(abandoned: Abandoned) -> None:
    assert abandoned.killed in ("FAILED", "OUT_OF_MEMORY")
    first, second = abandoned.memory
    assert second > first
    assert abandoned.resumed > 0


def test_jobs_outlive_the_restart_of_the_controller(abandoned: Abandoned) -> None:
    before, after = abandoned.restarted
    assert before == after == (abandoned.old, "RUNNING", "0")


def test_another_run_with_the_same_results_ends_with_a_message(abandoned: Abandoned) -> None:
    """Snakemake's lock is in the folder of the first one."""
    code, said, jobs = abandoned.other
    assert code != 0 and not jobs
    assert "results/tiny: another run is writing these results" in said
    assert "Traceback" not in said


def test_a_new_snakemake_holds_no_allocation_beside_the_jobs_of_a_killed_one(
    abandoned: Abandoned,
) -> None:
    assert abandoned.queued == [abandoned.old]
    assert f"scancel {abandoned.old}" in abandoned.second.text()
    log = abandoned.project / "results/tiny/logs/coarse.log"
    assert "coarse: up to date, nothing to do" in log.read_text(), "the old job's result is used"


def test_blocks_are_trained_on_both_nodes_at_once(abandoned: Abandoned, cluster: Cluster) -> None:
    jobs = Jobs(cluster)
    records = [jobs.record(job) for job in abandoned.second.submitted()]
    assert len(records) == 6
    for stage in ("block", "polish"):
        first, second = (
            next(r for r in records if r["Comment"] == f"rule_{stage}_wildcards_tiny_{block}")
            for block in (1, 2)
        )
        assert {first["NodeList"], second["NodeList"]} == {"n0", "n1"}, stage
        assert first["StartTime"] < second["EndTime"], stage
        assert second["StartTime"] < first["EndTime"], stage


def test_blocks_on_a_cluster_give_the_same_bits(
    abandoned: Abandoned, local_blocks: Future[Path]
) -> None:
    assert trained(abandoned.project) == trained(local_blocks.result())
