"""A disk that is full at any stage: one message, nothing half-written, and the same command goes on
when there is space again."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e.harness import TINY, copy_run, model_digests, snakemake

pytestmark = pytest.mark.slow

TARGET = "results/tiny/metrics.json"
LARGE_MB = 100


def mounted(folder: Path, *options: str) -> bool:
    command = ["mount", "-t", "tmpfs", "-o", ",".join(options), "tmpfs", str(folder)]
    return subprocess.run(command, check=False, capture_output=True).returncode == 0


@pytest.fixture(scope="module")
def disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A small disk, whose size changes."""
    folder = tmp_path_factory.mktemp("disk")
    if not mounted(folder, f"size={LARGE_MB}m"):
        pytest.skip("mounting a small disk needs the permission of root")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def resize(disk: Path, *, free_kb: int) -> None:
    status = os.statvfs(disk)
    used_kb = (status.f_blocks - status.f_bfree) * status.f_frsize // 1024
    assert mounted(disk, "remount", f"size={used_kb + free_kb}k")


@pytest.mark.parametrize(
    ("stage", "free_kb"),
    [("inspect", 0), ("sfm", 0), ("train", 40), ("report", 40)],
)
def test_a_full_disk_is_one_message_and_the_run_continues(
    disk: Path, finished: Path, stage: str, free_kb: int
) -> None:
    resize(disk, free_kb=LARGE_MB * 1024)
    project = copy_run(finished, disk / f"{stage}{free_kb}")
    shutil.rmtree(project / "results" / "tiny" / stage)
    (project / TARGET).unlink()
    resize(disk, free_kb=free_kb)
    failed = snakemake(project, TARGET, config=TINY, check=False)
    resize(disk, free_kb=LARGE_MB * 1024)
    assert failed.returncode != 0
    assert "the disk is full" in failed.stdout
    assert "Traceback" not in failed.stdout, failed.stdout
    assert max(map(len, failed.stdout.splitlines())) < 2000, "no command line"
    assert not (project / TARGET).exists()
    assert not list(project.glob("results/**/*.tmp"))
    assert not list(project.glob("results/tiny/.scratch/*/*/out"))
    snakemake(project, TARGET, config=TINY)
    assert model_digests(project, "tiny") == model_digests(finished, "tiny")
    shutil.rmtree(project)
