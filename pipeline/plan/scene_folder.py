"""A scene folder while it is scanned: what the scans of all kinds of files read and add to."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from pipeline.config.schema import Config
from pipeline.io.fact_cache import FactCache
from pipeline.io.posefiles import GivenPoses, pose_files
from pipeline.io.recorded import digest_of
from pipeline.runtime.errors import UserError


class Faults:
    """The errors about single files of a scene, collected so that one does not hide the others.

    Attributes:
        files: The files that the errors name.
        kinds: The kinds of files (those of the inventory) whose use is unknown due to an error.
    """

    def __init__(self) -> None:
        self._errors: list[UserError] = []
        self.files: list[Path] = []
        self.kinds: set[str] = set()

    @contextmanager
    def of(self, *kinds: str) -> Iterator[None]:
        """Keep a ``UserError`` of the block for ``check``.

        Args:
            kinds: The kinds of files that the block chooses.
        """
        try:
            yield
        except UserError as error:
            self._errors.append(error)
            self.kinds.update(kinds)
            if error.file is not None:
                self.files.append(Path(error.file))

    def __bool__(self) -> bool:
        return bool(self._errors)

    def check(self, warnings: Sequence[str]) -> None:
        """Raise the first error, with the other errors and ``warnings`` as its warnings.

        Raises:
            UserError: The first error, if there is any.
        """
        if self._errors:
            first, *others = self._errors
            first.warnings = (*warnings, *(str(error) for error in others))
            raise first


@dataclass(frozen=True)
class SceneFolder:
    """A scene folder, and what has been found about its files so far.

    Attributes:
        path: The scene folder.
        config: The configuration.
        cache: The facts about files that are known already.
        warnings: The warnings about its files, in the order in which they were found.
        faults: The errors about its files.
        used: The files that are used, or have a warning of their own.
    """

    path: Path
    config: Config
    cache: FactCache
    warnings: list[str] = field(default_factory=list)
    faults: Faults = field(default_factory=Faults)
    used: list[Path] = field(default_factory=list)

    @property
    def uses_masks(self) -> bool:
        """Whether masks in the folder are used; they are not for measures as published."""
        return self.config.views.masks == "use" and self.config.split.source != "published"

    def pose_files(self, poses: GivenPoses | None) -> list[Path]:
        """The files of the given poses; empty without given poses."""
        return [] if poses is None else pose_files(self.path / poses.path, poses.kind)

    def digest(self, file: Path) -> str:
        """The digest of a file's content."""
        return self.cache.get(file, "digest", str, partial(digest_of, file))

    def digest_of_files(self, files: Iterable[Path]) -> str:
        """The digest of the names, relative to the folder, and the contents of files."""
        lines = [f"{file.relative_to(self.path).as_posix()}\0{self.digest(file)}" for file in files]
        return digest_of_text("\n".join(sorted(lines)))


def digest_of_text(text: str) -> str:
    """The digest of a text."""
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
