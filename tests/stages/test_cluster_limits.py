"""Cores, memory and time of jobs on clusters."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.config.schema import Config
from pipeline.plan import duration
from pipeline.plan.plan import make_plan
from pipeline.plan.scan import scan
from pipeline.runtime import job, termination
from stages import __main__ as main
from stages.workflow import cluster
from stages.workflow import project as project_module
from stages.workflow.project import SnakemakeProject
from stages.workflow.registry import STAGES
from tests.pictures import photos
from tests.stages.flow import dry_run


def program(folder: Path, name: str, text: str, code: int = 0) -> Path:
    """A folder with a program that prints this."""
    program = folder / name
    program.write_text(f"#!/bin/sh\nprintf '{text}'\nexit {code}\n")
    program.chmod(0o755)
    return folder


@pytest.mark.parametrize(
    "text, node",
    [
        ("cpu* 2 6000\\ncpu* 4+ 3000\\nbig 64 500000\\n", cluster.Node(4, 6000)),
        ("a 2 6000\\nb 16 9000\\n", cluster.Node(16, 9000)),
        ("", None),
    ],
)
def test_the_largest_node_of_the_default_partition(tmp_path, monkeypatch, text, node):
    monkeypatch.setenv("PATH", str(program(tmp_path, "sinfo", text)), prepend=os.pathsep)
    cluster.largest_node.cache_clear()
    assert cluster.largest_node() == node
    cluster.largest_node.cache_clear()


def test_without_slurm_no_node_is_known(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    cluster.largest_node.cache_clear()
    assert cluster.largest_node() is None
    cluster.largest_node.cache_clear()


RUN = "12345678-1234-1234-1234-1234567890ab"


def test_earlier_jobs_are_those_of_snakemake_in_this_folder(tmp_path, monkeypatch):
    """Another program's job in this folder may be the Snakemake that looks; it must not wait for
    itself."""
    (tmp_path / "link").symlink_to(tmp_path)
    rows = [
        f"3|splatmake_{RUN}|{tmp_path}",
        f"4|{RUN}|{tmp_path}/link",
        f"5|{RUN}|{tmp_path}/other",
        f"6|snakemake|{tmp_path}",
    ]
    monkeypatch.setenv("PATH", str(program(tmp_path, "squeue", "\\n".join(rows))))
    assert cluster.earlier_jobs(tmp_path) == ["3", "4"]
    program(tmp_path, "squeue", "", code=1)
    assert cluster.earlier_jobs(tmp_path) == []


def test_a_run_waits_for_earlier_jobs_with_one_message(tmp_path, monkeypatch, capsys):
    answers = [["7", "8"], ["8"], []]
    monkeypatch.setattr(cluster, "earlier_jobs", lambda folder: answers.pop(0))
    monkeypatch.setattr(cluster, "QUEUE_SECONDS", 0.0)
    cluster.wait_for_earlier_jobs(tmp_path)
    assert not answers
    said = capsys.readouterr().err
    assert said.count("jobs of an earlier run") == 1
    assert "scancel 7 8" in said


def test_the_cores_of_a_job_are_those_it_was_given(monkeypatch):
    for name in ("SLURM_JOB_ID", "SLURM_CPUS_PER_TASK", "SLURM_CPUS_ON_NODE"):
        monkeypatch.delenv(name, raising=False)
    assert cluster.granted_cpus() is None
    monkeypatch.setenv("SLURM_CPUS_ON_NODE", "16")
    assert cluster.granted_cpus() is None
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    assert cluster.granted_cpus() == 16
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "2")
    assert cluster.granted_cpus() == 2


def test_jobs_ask_for_no_more_than_a_node_has(tmp_path, monkeypatch):
    """Slurm would refuse the third attempt of a large job, or never start it."""
    monkeypatch.chdir(tmp_path)
    for name in ("SLURM_JOB_ID", "SLURM_MEM_PER_NODE"):
        monkeypatch.delenv(name, raising=False)
    photos(tmp_path / "data" / "scene", 3)
    flow = dry_run(cores=2, resource_settings=SimpleNamespace(cores=16))
    project = SnakemakeProject({}, flow)
    scene = SimpleNamespace(scene="scene")
    needed = project.memory_mb(STAGES["train"])

    def wanted(attempt: int) -> int:
        return needed(scene, 1, attempt)

    local = wanted(1)
    assert project.threads(STAGES["train"])(scene) == 2
    flow.non_local_exec = True
    node = cluster.Node(4, local + cluster.OVERHEAD_MB + 1)
    monkeypatch.setattr(project_module, "largest_node", lambda: node)
    assert project.threads(STAGES["train"])(scene) == 4
    assert wanted(1) == local + cluster.OVERHEAD_MB
    assert wanted(2) == wanted(3) == node.memory_mb
    # In the job: what it was given.
    flow.non_local_exec, flow.remote_exec = False, True
    assert wanted(2) > node.memory_mb
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    monkeypatch.setenv("SLURM_MEM_PER_NODE", str(node.memory_mb))
    assert wanted(2) == node.memory_mb


@pytest.mark.parametrize(
    "variables",
    [
        {"JOB_ID": "7", "NSLOTS": "3"},
        {"PBS_JOBID": "7.host", "NCPUS": "3"},
        {"PBS_JOBID": "7.host", "PBS_NUM_PPN": "3"},
        {"LSB_JOBID": "7", "LSB_DJOB_NUMPROC": "3"},
    ],
)
def test_the_cores_of_jobs_of_other_clusters(monkeypatch, variables):
    monkeypatch.delenv("SLURM_JOB_ID", raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert cluster.granted_cpus() == 3


def test_a_stage_gets_the_threads_and_the_memory_of_its_job(tmp_path, monkeypatch):
    """On a cluster without the memory of the Snakemakes around it."""
    requests = []
    monkeypatch.setattr(job, "run_stage", lambda request, *_: requests.append(request))
    arguments = ["init", "--out", str(tmp_path), "--key", "{}", "--threads", "4"]
    monkeypatch.setattr(sys, "argv", ["stages", *arguments, "--memory-mb", "900"])
    monkeypatch.delenv("SLURM_JOB_ID", raising=False)
    main.main()
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "2")
    main.main()
    limits = [(request.threads, request.memory_mb) for request in requests]
    assert limits == [(4, 900), (2, 900 - cluster.OVERHEAD_MB)]


def test_time_limits_grow_with_the_scene_and_the_steps(tmp_path):
    photos(tmp_path / "few", 4)
    photos(tmp_path / "many", 60)
    few, many = (
        make_plan(scan(tmp_path / name, name, Config(), cache=None), Config(), STAGES)
        for name in ("few", "many")
    )
    for stage in STAGES:
        assert duration.minutes(stage, many) >= duration.minutes(stage, few) >= 10
    assert duration.seconds("matches", many) > duration.seconds("matches", few)
    divided = Config.model_validate({"features": {"photos_per_job": 10}})
    chunks = make_plan(scan(tmp_path / "many", "many", divided, cache=None), divided, STAGES)
    for stage, whole in (("extract", "features"), ("match", "matches")):
        assert duration.seconds(stage, chunks) < duration.seconds(whole, many) / 2
    longer = Config.model_validate({"train": {"budget_minutes": 600}})
    plan = make_plan(scan(tmp_path / "few", "few", longer, cache=None), longer, STAGES)
    assert duration.minutes("train", plan) >= 4 * 600


def test_a_scene_is_three_submissions_and_one_for_each_job_of_divided_stages(tmp_path):
    photos(tmp_path, 9)

    def groups(**options: dict[str, int]) -> dict[str, str | None]:
        config = Config.model_validate(options)
        plan = make_plan(scan(tmp_path, "x", config, cache=None), config, STAGES)
        return {stage: cluster.group_of(stage, plan) for stage in STAGES if plan.runs(stage)}

    assert set(groups().values()) == {"prepare", "train", "finish"}
    found = groups(features={"photos_per_job": 3}, partition={"blocks": 2})
    assert [stage for stage, group in found.items() if group is None] == [
        "extract",
        "match",
        "block",
        "polish",
    ]
    # A group must not depend on jobs that depend on it.
    assert found["inspect"] == "prepare"
    assert found["features"] == found["pairs"] == "prepare_1"
    assert found["matches"] == found["sfm"] == found["init"] == "prepare_2"
    assert found["coarse"] == found["partition"] == "coarse_2"
    assert found["train"] == found["export"] == "train_4"


def test_sigterm_ends_at_once_or_where_the_work_allows_it():
    with termination.raising_when_terminated():
        with pytest.raises(termination.Terminated):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)
        assert termination.requested()
    with termination.raising_when_terminated(), termination.deferred():
        assert not termination.requested()
        os.kill(os.getpid(), signal.SIGTERM)
        assert termination.requested()
