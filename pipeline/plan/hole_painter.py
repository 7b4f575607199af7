"""The program of ``holes.fill``, looked for before any job starts."""

from __future__ import annotations

import shlex
import shutil

from pipeline.runtime.errors import UserError


def check_hole_painter(fill: str) -> None:
    """Look for the program that the option ``holes.fill`` names, which is not ``none``: a misspelt
    ``inpaint`` would otherwise end a run only after training.

    Raises:
        UserError: There is no such program.
    """
    if fill == "inpaint":
        return
    program = shlex.split(fill)[0]
    if shutil.which(program) is None:
        raise UserError(
            f"holes.fill: expected none, inpaint or a command, found {fill!r}, and no program "
            f"{program!r} is installed",
            fix="correct the name, or give the program's path",
        )
