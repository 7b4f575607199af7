"""Errors about single files of a scene, collected so that one of them does not hide the others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pipeline.runtime.errors import UserError


class Faults:
    """The errors of the checks of a scene's files.

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
