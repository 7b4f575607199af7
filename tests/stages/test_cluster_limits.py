"""Cores, memory and time of jobs on clusters."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import pytest

from pipeline.config.schema import Config
from pipeline.plan import duration
from pipeline.plan.plan import make_plan
from pipeline.plan.scan import scan
from pipeline.runtime import termination
from stages import __main__ as main
from stages.workflow import cluster
from stages.workflow.registry import STAGES
from tests.pictures import photos


def sinfo(folder: Path, text: str, code: int = 0) -> Path:
    program = folder / "sinfo"
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
    monkeypatch.setenv("PATH", str(sinfo(tmp_path, text)), prepend=os.pathsep)
    cluster.largest_node.cache_clear()
    assert cluster.largest_node() == node
    cluster.largest_node.cache_clear()


def test_without_slurm_no_node_is_known(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    cluster.largest_node.cache_clear()
    assert cluster.largest_node() is None
    cluster.largest_node.cache_clear()


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


def test_a_stage_gets_the_threads_and_the_memory_of_its_job(tmp_path, monkeypatch):
    """On a cluster without the memory of the Snakemakes around it."""
    requests = []
    monkeypatch.setattr(main, "run_stage", lambda request, *_: requests.append(request))
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
    longer = Config.model_validate({"train": {"budget_minutes": 600}})
    plan = make_plan(scan(tmp_path / "few", "few", longer, cache=None), longer, STAGES)
    assert duration.minutes("train", plan) >= 4 * 600


def test_sigterm_ends_at_once_or_where_the_work_allows_it():
    with termination.raising_on_sigterm():
        with pytest.raises(termination.Terminated):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)
        assert termination.requested()
    with termination.raising_on_sigterm(), termination.deferred():
        assert not termination.requested()
        os.kill(os.getpid(), signal.SIGTERM)
        assert termination.requested()
