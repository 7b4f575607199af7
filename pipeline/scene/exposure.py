"""Exposure gains of the views (``exposure.json``)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar, Self

from pydantic import RootModel

from pipeline.runtime.json_file import JsonFile, Vector3, mismatch


class ExposureGains(JsonFile, RootModel[dict[str, Vector3]]):
    """RGB factors from the scene's typical exposure to each view's, for display values, by name of
    the view; empty if exposure is not modelled."""

    file_name: ClassVar[str] = "exposure.json"

    def __bool__(self) -> bool:
        return bool(self.root)

    def of(self, view: str) -> Vector3 | None:
        """The gain of a view; None if exposure is not modelled."""
        return self.root[view] if self.root else None

    @classmethod
    def read_for(cls, folder: Path, views: Iterable[str]) -> Self:
        """Read the gains of these views.

        Raises:
            UserError: the file is missing or damaged, or lacks one of the views.
        """
        gains, names = cls.read(folder), set(views)
        missing = sorted(names - gains.root.keys()) if gains else []
        if missing:
            raise mismatch(
                folder / cls.file_name,
                f"expected the gains of {len(names)} views, found none for {missing[0]}",
            )
        return gains


NO_GAINS = ExposureGains({})
