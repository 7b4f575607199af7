"""Options of filled holes."""

from __future__ import annotations

import shlex
from typing import Annotated

from pydantic import AfterValidator, Field

from pipeline.config.section import Section
from pipeline.runtime.text import is_plain

#: The largest number of characters of a command.
MAX_COMMAND = 4000


def _plain_command(fill: str) -> str:
    if not fill.strip() or not is_plain(fill) or len(fill) > MAX_COMMAND:
        raise ValueError(
            "Input should be none, inpaint or a command: one line of UTF-8 of at most "
            f"{MAX_COMMAND} characters"
        )
    try:
        shlex.split(fill)
    except ValueError as error:
        raise ValueError(f"Input should be none, inpaint or a command ({error})") from None
    return fill


class Holes(Section):
    """The places that no photograph shows."""

    fill: Annotated[str, AfterValidator(_plain_command)] = Field(
        "none",
        description="none: they stay as training leaves them. inpaint: Gaussians are invented "
        "there, in the colours around each hole. Anything else is a command that paints the holes "
        "of rendered views, called as COMMAND IMAGE.png MASK.png OUTPUT.png, without a shell. No "
        "measure of quality counts what is invented; metrics.json and the page tell its share.",
    )
