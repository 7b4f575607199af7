"""Download of files with known contents."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from urllib.request import urlopen

from pipeline.runtime.atomic import written
from pipeline.runtime.errors import UserError
from pipeline.runtime.progress import Progress

_TIMEOUT_S = 30.0
_PIECE = 1_000_000


@dataclass(frozen=True)
class RemoteFile:
    """A file that is published under a URL.

    Attributes:
        name: The name under which it is stored.
        size: Its size in bytes.
        sha256: The SHA-256 digest of its content, in hexadecimal digits.
    """

    name: str
    url: str
    size: int
    sha256: str

    def is_at(self, path: Path) -> bool:
        """Whether the file at ``path`` has this content."""
        if not path.is_file() or path.stat().st_size != self.size:
            return False
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest() == self.sha256

    def download(self, path: Path) -> None:
        """Write the file to ``path``, whole or not at all.

        Raises:
            UserError: The server is not reached, or sends something else.
            OSError: The file cannot be written.
        """
        digest, received = hashlib.sha256(), 0
        progress = Progress(f"downloading {self.name}", -(-self.size // _PIECE), "MB")
        with written(path) as file:
            for piece in self._pieces(path):
                file.write(piece)
                digest.update(piece)
                received += len(piece)
                if received > self.size:
                    break
                progress.advance()
            if received != self.size or digest.hexdigest() != self.sha256:
                more = "more than " if received > self.size else ""
                raise UserError(
                    f"expected {self.size} bytes with the SHA-256 digest {self.sha256}, found "
                    f"{more}{received} bytes with {digest.hexdigest()}",
                    file=self.url,
                    fix="try again; if it stays, a proxy may have sent a page of its own",
                )

    def _pieces(self, path: Path) -> Iterator[bytes]:
        try:
            with urlopen(self.url, timeout=_TIMEOUT_S) as answer:
                while piece := answer.read(_PIECE):
                    yield piece
        except (OSError, HTTPException) as error:
            raise UserError(
                f"expected to download this file, found: {getattr(error, 'reason', error)}",
                file=self.url,
                fix="connect this machine to the internet ($https_proxy names a proxy), or "
                f"download it elsewhere and store it as {path}",
            ) from error
