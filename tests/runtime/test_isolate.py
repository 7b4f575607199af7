"""``run_isolated`` returns values, raises errors of its process and leaves no process behind."""

from __future__ import annotations

import multiprocessing
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipeline.runtime.errors import UserError
from pipeline.runtime.isolate import Limits, OverLimitError, run_isolated, run_limited
from tests.sfm import jobs


def test_the_value_is_returned():
    assert run_isolated(jobs.returned, {"a": [1, 2]}) == {"a": [1, 2]}


def test_a_program_without_a_main_guard_is_not_run_again(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(
        "print('started')\n"
        "from pipeline.runtime.isolate import run_isolated\n"
        "from tests.sfm import jobs\n"
        "print(run_isolated(jobs.returned, 1))\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(
        [sys.executable, program], env=environment, capture_output=True, text=True, timeout=120
    )
    assert (done.stdout, done.returncode) == ("started\n1\n", 0), done.stderr


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


def test_a_function_that_takes_too_long_is_ended():
    start = time.monotonic()
    with pytest.raises(OverLimitError, match="sleep took longer than 2 s"):
        run_limited(Limits(seconds=2), jobs.sleep, 600)
    assert time.monotonic() - start < 60
    assert run_limited(Limits(seconds=60), jobs.returned, 1) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="not run: the kernel has no such limit")
def test_a_function_that_takes_too_much_memory_is_ended():
    limits = Limits(memory=256 << 20)
    assert run_limited(limits, jobs.allocate, 128 << 20) == 128 << 20
    with pytest.raises(OverLimitError, match="allocate needed more than 256 MiB"):
        run_limited(limits, jobs.allocate, 512 << 20)


def test_a_function_without_network_reaches_nothing():
    if sys.platform != "linux" or not run_isolated(jobs.may_have_no_network):
        pytest.skip("not run: this kernel does not let a process give up its network")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert run_limited(Limits(), jobs.connects, port)
        assert not run_limited(Limits(network=False), jobs.connects, port)


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
