"""Reading photographs, masks and depth maps whose digests are recorded in ``images.json``."""

from __future__ import annotations

import hashlib
from pathlib import Path

from pipeline.io.bounded import opened_regular, read_bounded
from pipeline.runtime.errors import ChangedFileError
from pipeline.runtime.record import changed, owner_of, rerun

MAX_BYTES = 4 << 30
"""Largest file of a photograph, a mask or a depth map: 512 megapixels of 16-bit RGB and alpha."""
_DIGEST_BYTES = 16


def digest_of(path: Path) -> str:
    """Hex digest of a file's bytes.

    Raises:
        OSError: The file cannot be read, or is not a regular file.
    """
    with opened_regular(path) as file:
        return hashlib.file_digest(file, _hash).hexdigest()


def read_recorded(path: str | Path, digest: str | None) -> bytes:
    """The bytes of a file, checked against its digest.

    Decode these bytes instead of reading the file again, which may have changed since.

    Args:
        digest: The recorded result of ``digest_of``; None: no check.

    Raises:
        ChangedFileError: the file has another digest.
        UserError: the file cannot be read, or is larger than ``MAX_BYTES``.
    """
    path = Path(path)
    data = read_bounded(
        path, MAX_BYTES, fix="replace the file by a whole one, or remove it from the folder"
    )
    if digest is None or _hash(data).hexdigest() == digest:
        return data
    folder = owner_of(path)
    if folder is not None:
        raise ChangedFileError(changed(folder), file=path, fix=rerun(folder))
    raise ChangedFileError(
        "has changed since the scene was inspected",
        file=path,
        fix="run the same command again: the stages that use this file are run again; "
        "leave the scene's files unchanged while snakemake runs",
    )


def _hash(data: bytes = b"") -> hashlib.blake2b:
    return hashlib.blake2b(data, digest_size=_DIGEST_BYTES)
