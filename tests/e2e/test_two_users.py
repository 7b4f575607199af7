"""Two Unix users and one folder of results."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.e2e.harness import TINY, arguments, copy_run, environment, make_project
from tests.tools import need, unsupported

pytestmark = pytest.mark.slow

GROUP = 61000
STAGE = "results/tiny/init"
# Reads all files, as the interpreter and the sources may be in a folder of root; writes its own.
READER = ("--inh-caps", "+dac_read_search", "--ambient-caps", "+dac_read_search")


@dataclass(frozen=True)
class User:
    """An unprivileged user.

    Attributes:
        umask: of its files.
    """

    name: str
    number: int
    home: Path
    umask: int

    def command(self, *words: str, reads_all: bool = True) -> list[str]:
        ids = ("--reuid", str(self.number), "--regid", str(GROUP), "--clear-groups")
        return ["setpriv", *ids, *(READER if reads_all else ()), "--", *words]

    def snakemake(self, project: Path, *options: str) -> subprocess.Popen[str]:
        """Start Snakemake, whose job is a stage that takes few seconds."""
        words = arguments(f"{STAGE}/stage.json", *options, config=TINY)
        return subprocess.Popen(
            self.command(sys.executable, "-m", "snakemake", *words),
            cwd=project,
            env=environment(project) | {"HOME": str(self.home), "LOGNAME": self.name},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            umask=self.umask,
            start_new_session=True,
        )

    def owns(self, folder: Path) -> None:
        """Give a folder to this user, with the permissions of its umask."""
        for path in (folder, *folder.rglob("*")):
            os.chown(path, self.number, GROUP, follow_symlinks=False)
            if not path.is_symlink():
                path.chmod((0o777 if path.is_dir() else 0o666) & ~self.umask)


def ended(run: subprocess.Popen[str]) -> tuple[int, str]:
    said, _ = run.communicate(timeout=600)
    assert "Traceback" not in said
    return run.returncode, said


def contents(folder: Path) -> dict[str, tuple[int, bytes]]:
    """The files below a folder: times and bytes."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(file): (file.stat().st_mtime_ns, file.read_bytes()) for file in files}


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder that all users may read, unlike pytest's."""
    if os.geteuid() != 0:
        unsupported("only root becomes another user")
    need("setpriv")
    folder = Path(tempfile.mkdtemp(prefix="users-"))
    folder.chmod(0o755)
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


def users(folder: Path, umask: int) -> tuple[User, User]:
    found = []
    for number, name in enumerate(("first", "second"), GROUP + 1):
        user = User(name, number, folder / f"home-{name}", umask)
        user.home.mkdir()
        user.owns(user.home)
        found.append(user)
    check = found[0].command(sys.executable, "-c", "import snakemake")
    if done := subprocess.run(check, capture_output=True, text=True).stderr:
        unsupported(f"another user cannot run this Python: {done}")
    return found[0], found[1]


@pytest.fixture(params=[0o022, 0o002], ids=["private", "shared"])
def case(request: pytest.FixtureRequest, folder: Path, finished: Path) -> tuple[User, User, Path]:
    """Two users of one group, and a project of the first that has one stage to run; whether the
    second may write its files."""
    first, second = users(folder, request.param)
    project = copy_run(finished, folder / "project")
    shutil.rmtree(project / STAGE)
    first.owns(project)
    return first, second, project


def elsewhere(project: Path, user: User) -> Path:
    """A working directory of another user with the same scenes and results."""
    folder = make_project(project.parent / "elsewhere")
    user.owns(folder)
    for name in ("data", "results"):
        (folder / name).symlink_to(project / name)
    return folder


def test_a_second_user_is_told_who_writes_the_results(case: tuple[User, User, Path]) -> None:
    first, second, project = case
    shared = first.umask == 0o002
    other = elsewhere(project, second)
    run = first.snakemake(project)
    lock = project / "results/tiny/.scratch/run.lock"
    # Its content is older if no run has locked it.
    while f"process {run.pid}\n" not in lock.read_text():
        assert run.poll() is None, ended(run)
        time.sleep(0.05)
    os.killpg(run.pid, signal.SIGSTOP)
    try:
        before = contents(project / "results")
        for place in (other, project) if shared else (other,):
            code, said = ended(second.snakemake(place))
            assert code == 2
            who = f"first on {os.uname().nodename}, process {run.pid}"
            assert said.count("error: ") == 1
            assert f"results/tiny: another run is writing these results ({who})" in said
        assert contents(project / "results") == before
    finally:
        os.killpg(run.pid, signal.SIGCONT)
    assert ended(run)[0] == 0

    before = contents(project / "results")
    code, said = ended(second.snakemake(other, "--forcerun", "init"))
    if shared:
        assert code == 0, said
        assert (project / STAGE / "stage.json").stat().st_uid == second.number
    else:
        assert code != 0
        assert "Write-protected output files for rule init" in said
        assert f"{STAGE}/stage.json" in said
        assert contents(project / "results") == before
        code, said = ended(second.snakemake(project))
        assert code == 2
        assert f"{project}/.snakemake: Snakemake cannot write to this folder" in said
