"""What is behind a scene (``background.json``)."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, TypeVar

from pipeline.config.schema import Train
from pipeline.config.settled import Background
from pipeline.runtime.json_file import JsonFile

T = TypeVar("T", bound=Train)


class SceneBackground(JsonFile):
    """The background that the stage ``init`` decided on, which later stages draw the scene over.

    Attributes:
        background: The value of ``train.background``, which is not "measured".
        reason: The sentence that gives the value and the reason.
    """

    file_name: ClassVar[str] = "background.json"

    background: Background
    reason: str


def with_background(train: T, folder: Path) -> T:
    """The options of training, with the background that the stage ``init`` decided on.

    Args:
        folder: The folder of the stage ``init``, or of a stage that trains.

    Raises:
        UserError: The file is missing or damaged.
    """
    if train.background != "measured":
        return train
    found = SceneBackground.read(folder).background
    return train.model_copy(update={"background": found})
