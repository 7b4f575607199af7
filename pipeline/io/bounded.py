"""Reading whole files whose size nobody has checked: regular files up to a limit."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

from pipeline.runtime.errors import UserError
from pipeline.runtime.machine import usable_memory

MIB = 1 << 20
UTF_16_MARKS = (b"\xff\xfe", b"\xfe\xff")


@contextmanager
def opened_regular(path: Path) -> Iterator[BufferedReader]:
    """An open regular file.

    Raises:
        OSError: The file cannot be opened, or is a device or a pipe, which may have no end.
    """
    # Without O_NONBLOCK, opening a pipe waits for a writer.
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
        yield file


@contextmanager
def opened_bounded(path: Path, limit: int | None = None, *, fix: str) -> Iterator[BufferedReader]:
    """An open regular file of a bounded size.

    Args:
        limit: The largest number of bytes; None for half of the memory.
        fix: What to do about a file that cannot be read.

    Raises:
        UserError: The file cannot be read, is a device or a pipe, or is larger than ``limit``.
    """
    largest = usable_memory() // 2 if limit is None else limit
    try:
        with opened_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size > largest:
                reason = " (half of the memory)" if limit is None else ""
                what = f"expected at most {largest // MIB} MiB{reason}, found {size // MIB} MiB"
                raise UserError(what, file=path, fix=fix)
            yield file
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror}", file=path, fix=fix) from None


def read_bounded(path: Path, limit: int | None = None, *, fix: str) -> bytes:
    """The bytes of a file; see ``opened_bounded``."""
    with opened_bounded(path, limit, fix=fix) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def read_text(path: Path, limit: int, *, fix: str) -> str:
    """The text of a file: UTF-8 with or without byte order mark, or UTF-16, which Windows' tools
    write.

    Raises:
        UserError: See ``read_bounded``; or the bytes are no such text.
    """
    data = read_bounded(path, limit, fix=fix)
    try:
        return data.decode("utf-16" if data[:2] in UTF_16_MARKS else "utf-8-sig")
    except UnicodeDecodeError as error:
        what = f"expected UTF-8 or UTF-16 text: {error}"
        raise UserError(what, file=path, fix=fix) from None
