"""The locks of a run and of a stage."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.runtime.errors import UserError
from pipeline.runtime.lock import check_not_locked, lock_run, locked

HOLD = """
import sys
from pathlib import Path
from pipeline.runtime.lock import check_not_locked, lock_run, locked
lock_run(Path(sys.argv[1]))
print("locked", flush=True)
sys.stdin.read()
"""


def test_a_second_run_is_refused_until_the_first_has_ended_or_was_killed(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)],
        cwd=Path(__file__).parents[2],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "locked\n"
        with pytest.raises(UserError, match=rf"another run is .* process {first.pid}\)") as raised:
            lock_run(tmp_path)
        assert raised.value.file == tmp_path
        first.kill()
    lock_run(tmp_path)


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_file_system_without_locks_is_a_warning(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    code: int,
) -> None:
    """NFS without a lock daemon and some mounts of Lustre have none."""

    def refuse(*arguments: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", refuse)
    check_not_locked(tmp_path)
    lock_run(tmp_path)
    said = capsys.readouterr().err
    assert said.count("warning") == 1 and "its file system has no locks" in said
    with locked(tmp_path / "sfm.lock", "sfm", tmp_path / "sfm"):
        pass
    assert capsys.readouterr().err == ""
