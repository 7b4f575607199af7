"""Errors that the user can correct."""

from __future__ import annotations

import errno
from pathlib import Path

from pipeline.runtime.text import without_middle

EXIT_USER_ERROR = 2
EXIT_NOT_ACCEPTED = 1
"""A result does not meet the rules of ``splatmake accept``."""
# The largest numbers of characters of a line, and of the parts of a message.
_MAX_LINE = 600
_MAX_WHAT, _MAX_FILE, _MAX_FIX = 1150, 280, 450
ELSEWHERE = "--out of splatmake run, --directory of snakemake"
"""How a run in another folder is started."""
EXIT_INTERRUPTED = 130
"""By convention 128 and the number of the signal, SIGINT."""


class UserError(Exception):
    """An error in the user's input or environment.

    A stage that raises it ends with its message and exit code 2, without a traceback.

    Args:
        what: A sentence that says what was expected and what was found.
        file: The file or folder concerned, if any.
        fix: A sentence that says what to do.

    Attributes:
        warnings: Sentences about other files of the same input, to be shown before the error.
    """

    warnings: tuple[str, ...] = ()

    def __init__(self, what: str, *, file: str | Path | None = None, fix: str | None = None):
        self.what, self.file = _printable(what, _MAX_WHAT), file
        self.fix = None if fix is None else _printable(fix, _MAX_FIX)
        super().__init__(str(self))

    def __str__(self) -> str:
        name = _printable(str(self.file).replace("\n", "\\n"), _MAX_FILE)
        where = f"{name}: " if self.file is not None else ""
        text = f"{where}{self.what}"
        return f"{text}\n  what to do: {self.fix}" if self.fix else text


def _printable(text: str, limit: int) -> str:
    """``text`` of at most ``limit`` characters, in lines of bounded length without control
    characters: messages quote files and their names, which may hold anything.

    Lines beyond the limit are counted.
    """
    lines = text.split("\n")
    shown: list[str] = []
    for number, line in enumerate(lines):
        cut = without_middle(line, _MAX_LINE)
        if not cut.isprintable():
            cut = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in cut)
        cut = without_middle(cut, min(_MAX_LINE, limit))
        if sum(map(len, shown)) + len(shown) + len(cut) > limit:
            return "\n".join([*shown, f"... and {len(lines) - number} more lines"])
        shown.append(cut)
    return "\n".join(shown)


class ChangedFileError(UserError):
    """A file of the scene or of a stage is not the one that was recorded."""


def as_user_error(error: OSError) -> UserError | None:
    """The ``UserError`` for a full disk or missing permissions; None for other errors."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        fix = f"free some space, or run in a folder on a larger disk ({ELSEWHERE})"
        return UserError("the disk is full", file=error.filename, fix=fix)
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        fix = f"make it writable, or run in another folder ({ELSEWHERE})"
        return UserError("permission denied", file=error.filename, fix=fix)
    return None
