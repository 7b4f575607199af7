"""Reading of other programs' text, JSON and XML files, which are hostile until checked.

Functions raise a ``UserError`` that names the file.
"""

from __future__ import annotations

import json
import posixpath
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from pipeline.io import bounded
from pipeline.io.bounded_xml import parse_xml
from pipeline.runtime.errors import UserError
from pipeline.runtime.text import shown

FIX = "correct the file, export it again, or set poses: ignore"
# Larger files are no list of cameras: 100,000 photographs take about 100 MiB.
_MAX_BYTES = 256 * 2**20
# Bytes of memory that a JSON file's objects, lists and values take at least, by what begins them.
_JSON_BYTES = {"{": 240, "[": 90, ",": 40}
_MAX_JSON_MEMORY = 2 << 30
_MAX_NAME = 1000
_HEAD_BYTES = 4096


def malformed(file: Path, what: str, fix: str = FIX) -> UserError:
    return UserError(what, file=file, fix=fix)


def checked_name(file: Path, name: str, where: str = "") -> str:
    """``name`` with "/" between folders and without "." and inner ".."; relative to the folder of
    ``file`` if it is absolute and inside of it.

    Args:
        where: The text that precedes the message.
    """
    plain = posixpath.normpath(name.replace("\\", "/"))
    if not name or len(name) > _MAX_NAME or any(len(p) > 240 for p in plain.split("/")):
        raise malformed(file, f"{where}expected a file name, found {shown(name)}")
    if any(ord(c) < 32 or 0xD800 <= ord(c) < 0xE000 for c in name):
        raise malformed(file, f"{where}expected a file name, found {shown(name)}")
    if not posixpath.isabs(plain):
        return plain
    folder = str(file.parent.resolve())
    return posixpath.relpath(plain, folder) if plain.startswith(folder + "/") else plain


def read_text(file: Path) -> str:
    """The text of a pose file, see ``bounded.read_text``."""
    return bounded.read_text(file, _MAX_BYTES, fix=FIX)


def read_xml(file: Path) -> Element:
    """The root element of an XML file.

    Raises:
        UserError: The file is too large, not well-formed, nested too deeply, or with a document
            type.
    """
    try:
        return parse_xml(bounded.read_bounded(file, _MAX_BYTES, fix=FIX))
    except ValueError as error:
        raise malformed(file, str(error)) from None


def read_head(file: Path) -> bytes:
    """The first bytes of a file; as UTF-8 if the file is UTF-16."""
    with file.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    if head[:2] in bounded.UTF_16_MARKS:
        return head.decode("utf-16", errors="ignore").encode(errors="ignore")
    # XML names its encoding only in its own encoding.
    for start, encoding in ((b"<\0", "utf-16-le"), (b"\0<", "utf-16-be")):
        if head.startswith(start):
            return head.decode(encoding, errors="ignore").encode(errors="ignore")
    return head


def read_json(file: Path) -> Any:
    """The content of a JSON file; integers beyond 64 bits become floats."""
    text = read_text(file)
    if sum(text.count(mark) * size for mark, size in _JSON_BYTES.items()) > _MAX_JSON_MEMORY:
        raise malformed(
            file, f"expected JSON that takes at most {_MAX_JSON_MEMORY >> 20} MiB of memory"
        )
    try:
        return json.loads(text, parse_int=_integer)
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise malformed(file, f"{where}: not valid JSON ({error.msg})") from None
    except RecursionError:
        raise malformed(file, "not valid JSON (nested too deeply)") from None


def _integer(digits: str) -> int | float:
    return int(digits) if len(digits) < 19 else float(digits)


def is_number(value: Any) -> bool:
    """Whether ``value`` is a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 1e300  # False for NaN.


def number(file: Path, where: str, value: Any) -> float:
    """``value``, or the number that it is the text of."""
    try:
        found = float(value) if isinstance(value, str) else value
        if is_number(found):
            return float(found)
    except ValueError:
        pass
    raise malformed(file, f"{where}: expected a finite number, found {shown(value)}")


def numbers(file: Path, where: str, value: Any, count: int) -> NDArray[np.float64]:
    """(count,) the numbers of a list or of a text with blanks between them."""
    listed = value.split() if isinstance(value, str) else value
    if not isinstance(listed, list | tuple) or len(listed) != count:
        raise malformed(file, f"{where}: expected {count} numbers, found {shown(value)}")
    return np.array([number(file, where, entry) for entry in listed])


def first_file(folder: Path, names: Iterable[str]) -> str | None:
    """The first of ``names`` that is a file in ``folder``; None without any."""
    return next((name for name in names if (folder / name).is_file()), None)


def find_by_head(folder: Path, suffix: str, is_one: Callable[[bytes], bool]) -> str | None:
    """The first file in ``folder``, sorted by name, with this suffix in any case, whose first
    bytes ``is_one`` accepts."""
    if not folder.is_dir():
        return None
    for file in sorted(folder.iterdir()):
        usable = file.suffix.lower() == suffix and file.is_file() and file.name[0] != "."
        if usable and is_one(read_head(file)):
            return file.name
    return None
