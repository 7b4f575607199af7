"""What runs print, word by word: the files beside this one are the expected texts.

Measured values, which differ between machines, are masked. ``SPLATMAKE_NEW_TRANSCRIPTS=1`` in the
environment writes the files anew; the differences are then reviewed.
"""

from __future__ import annotations

import os
import re
from difflib import unified_diff
from pathlib import Path

FOLDER = Path(__file__).parent
# The order of stages that may run in parallel is not fixed.
_PARALLEL = ("export", "evaluate", "coverage")
_MASKS = (
    (r"\S+\.snakemake\.log", "<log>"),
    (r" +\d+(\.\d+)? (s|min \d+ s|h \d+ min)(?![a-z])", " <time>"),
    (r"step \d+ of", "step <number> of"),
    (r"-?\d+\.\d+|\d+%|\d+(?= inliers)", "<number>"),
    (r"\b\d{1,3}(,\d{3})+\b|\b\d{3,}\b(?! steps)", "<number>"),
)
# A line a minute for a job that runs, so that the lines depend on the machine's speed.
_PROGRESS = re.compile(
    r"  (?!warning:|.* failed in )\S+ +(\S+ +)?(running$|[^:]*: \w+ (\d+|<number>) of [\d<])"
    r"|.* finished, \d+ to do$"
)


def masked(text: str) -> str:
    """``text`` without what differs between machines."""
    for pattern, name in _MASKS:
        text = re.sub(pattern, name, text)
    # Columns are as wide as their values.
    lines = [
        re.sub(r"(?<=\S) {2,}", "  ", line).rstrip()
        for line in text.splitlines()
        if not _PROGRESS.match(line)
    ]
    ended = [line for line in lines if line.endswith("<time>") and line.split()[0] in _PARALLEL]
    ordered = iter(sorted(ended))
    return "\n".join(next(ordered) if line in ended else line for line in lines) + "\n"


def check(name: str, text: str, *, lines: int) -> None:
    """Compare what a run has printed with ``<name>.txt``.

    Args:
        lines: The most lines that the run may print.
    """
    found, file = masked(text), FOLDER / f"{name}.txt"
    if os.environ.get("SPLATMAKE_NEW_TRANSCRIPTS"):
        file.write_text(found)
    expected = file.read_text()
    assert found == expected, "\n".join(
        unified_diff(expected.splitlines(), found.splitlines(), "expected", "found", lineterm="")
    )
    assert len(found.splitlines()) <= lines
