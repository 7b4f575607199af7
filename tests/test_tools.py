"""CI skips nothing that an installed package would let run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = """
import pytest
from tests import tools

def test_program(): tools.need("no-such-program")
def test_package(): tools.need_package("no-such-package")
def test_version(): tools.need_package("pytest", "0.0.1")
def test_import(): pytest.importorskip("no_such_module")
@pytest.mark.skipif(True, reason="no such thing")
def test_mark(): pass
@pytest.fixture
def thing(): pytest.skip("no such thing")
def test_fixture(thing): pass
def test_machine(): tools.unsupported("no such processor")
def test_data(): tools.need_data("no-such-data")
@pytest.mark.xfail
def test_expected(): raise AssertionError
"""


@pytest.mark.parametrize(
    ("required", "outcome"),
    [("", "9 skipped, 1 xfailed"), ("1", "4 failed, 2 skipped, 1 xfailed, 3 errors")],
)
def test_a_skip_for_want_of_a_package_fails_in_ci(
    tmp_path: Path, required: str, outcome: str
) -> None:
    (tmp_path / "test_skips.py").write_text(TESTS)
    (tmp_path / "test_module.py").write_text("import pytest\npytest.importorskip('no_such')\n")
    command = [sys.executable, "-m", "pytest", "-p", "tests.conftest", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [*command, "--continue-on-collection-errors", "--rootdir", tmp_path, tmp_path],
        cwd=Path(__file__).parents[1],
        env=os.environ | {"SPLATMAKE_REQUIRE_ALL": required},
        capture_output=True,
        text=True,
        check=False,
    )
    assert outcome in done.stdout.splitlines()[-1], done.stdout + done.stderr
    assert done.returncode == bool(required)
