"""What is behind a scene (``background.json``)."""

from __future__ import annotations

from typing import ClassVar

from pipeline.config.settled import Background
from pipeline.runtime.json_file import JsonFile


class SceneBackground(JsonFile):
    """The background that the stage ``init`` decided on, which later stages draw the scene over.

    Attributes:
        background: The value of ``train.background``, which is not "measured".
        reason: The sentence that gives the value and the reason.
    """

    file_name: ClassVar[str] = "background.json"

    background: Background
    reason: str
