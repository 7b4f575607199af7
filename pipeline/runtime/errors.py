"""The one exception a user can cause."""

from __future__ import annotations

from pathlib import Path


class UserError(Exception):
    """Something in the user's input or surroundings that only the user can mend.

    A stage that raises it ends with one clear message and exit code 2; never a traceback.

    Args:
        what: what is wrong, one sentence, naming what was expected and what was found.
        file: the file or folder it is about, if there is one.
        fix: what to do about it, one sentence.
    """

    def __init__(self, what: str, *, file: str | Path | None = None, fix: str | None = None):
        self.what, self.file, self.fix = what, file, fix
        super().__init__(str(self))

    def __str__(self) -> str:
        text = f"{self.file}: {self.what}" if self.file is not None else self.what
        return f"{text}\n  what to do: {self.fix}" if self.fix else text
