"""``run_isolated`` returns values, raises errors of its process and leaves no process behind."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Iterator
from multiprocessing.context import SpawnContext

import pytest

from pipeline.runtime.errors import UserError
from pipeline.runtime.isolate import run_isolated
from tests.forked import spawning
from tests.sfm import jobs


@pytest.fixture(autouse=True)
def new_processes() -> Iterator[None]:
    with spawning(SpawnContext()):
        yield


def test_the_value_is_returned():
    assert run_isolated(jobs.returned, {"a": [1, 2]}) == {"a": [1, 2]}


def test_a_user_error_keeps_its_fields():
    with pytest.raises(UserError) as caught:
        run_isolated(jobs.raise_user_error)
    assert (caught.value.what, caught.value.file, caught.value.fix) == (
        "is wrong",
        "a.jpg",
        "repair it",
    )


def test_other_exceptions_show_their_traceback():
    with pytest.raises(RuntimeError, match=r"raise_bug(.|\n)*KeyError: 'lost'"):
        run_isolated(jobs.raise_bug)


def test_a_killed_process_raises_with_the_name_of_the_signal():
    with pytest.raises(RuntimeError, match="SIGKILL"):
        run_isolated(jobs.die)


def test_the_process_ends_with_its_parent(tmp_path):
    started = tmp_path / "pid"
    parent = multiprocessing.get_context("spawn").Process(
        target=jobs.wait_for_sleeper, args=(started,)
    )
    parent.start()
    for _ in range(600):
        if started.exists() and started.read_text():
            break
        time.sleep(0.05)
    child = int(started.read_text())
    parent.kill()
    parent.join()
    for _ in range(200):
        if not _alive(child):
            return
        time.sleep(0.05)
    os.kill(child, 9)
    pytest.fail("the process outlived its parent")


def _alive(pid: int) -> bool:
    """False for a zombie too."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
