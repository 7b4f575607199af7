"""Reading whole files whose size nobody has checked: regular files up to a limit."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from pipeline.runtime.errors import UserError

MIB = 1 << 20


def read_bounded(path: Path, limit: int, *, fix: str) -> bytes:
    """The bytes of a file.

    Args:
        limit: largest number of bytes.
        fix: what to do about a file that cannot be read.

    Raises:
        UserError: it is not a regular file (a device or a pipe would never end), is larger than
            ``limit``, or cannot be read.
    """
    try:
        # Without O_NONBLOCK, opening a pipe waits for a writer.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        with open(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode):
                raise UserError("expected a regular file, found another kind", file=path, fix=fix)
            if status.st_size > limit:
                raise UserError(
                    f"expected at most {limit // MIB} MiB, found {status.st_size // MIB} MiB",
                    file=path,
                    fix=fix,
                )
            return file.read(limit)
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror}", file=path, fix=fix) from None
