"""Painters of holes: functions that fill the masked pixels of an image.

``inpaint`` continues the colours around holes smoothly; ``PaintCommand`` runs a program of the
user's.
"""

from __future__ import annotations

import io
import os
import shlex
import signal
import subprocess
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.render.views import to_bytes, write_png
from pipeline.runtime.errors import UserError

Picture = NDArray[np.uint8]
Bools = NDArray[np.bool_]
Doubles = NDArray[np.float64]
#: A function of an image (H, W, 3) uint8 RGB, the mask (H, W) of its holes, and weights (H, W) by
#: which the other pixels are like what belongs into the holes. It returns an image of the same
#: shape, of which only the pixels of the holes are used.
Painter = Callable[[Picture, Bools, Doubles], Picture]

#: Pixels of a level of ``pull_push`` are known if their mean weight is at least this.
SATURATION = 0.5
#: The time in seconds after which the user's program is ended.
TIME_LIMIT_S = 600.0
#: The number of lines and characters of a program's last messages that an error quotes.
_LAST_LINES, _LAST_BYTES = 5, 4000
_CONTRACT = (
    "the command is called as COMMAND IMAGE.png MASK.png OUTPUT.png and must write OUTPUT.png, an "
    "image of 8-bit RGB of the size of IMAGE.png (docs/guides/holes.md)"
)


def painter_of(fill: str) -> Painter:
    """The painter that the option ``holes.fill`` names, which is not ``none``. A command is split
    as a shell does; none is started."""
    return inpaint if fill == "inpaint" else PaintCommand(tuple(shlex.split(fill)))


def inpaint(image: Picture, hole: Bools, weights: Doubles) -> Picture:
    """Continue the colours around the holes into them: sharp at their edges, smooth farther in.

    Sharper methods, such as those of OpenCV, draw streaks into large holes, and their errors are
    larger.
    """
    filled = pull_push(image.astype(np.float64), np.where(hole, 0.0, weights))
    return np.where(hole[..., None], to_bytes(filled / 255), image)


def pull_push(values: Doubles, weights: Doubles) -> Doubles:
    """(H, W, C) the values where weights are 1, elsewhere a smooth continuation (Gortler et al.
    1996, "The Lumigraph", section 3.5).

    Args:
        values: (H, W, C) of any value where weights are 0.
        weights: (H, W) 0 to 1, not all 0.
    """
    sums = np.where(weights[..., None] > 0, values, 0.0) * weights[..., None]
    return _pull_push(sums, weights, 1)


def _pull_push(sums: Doubles, weights: Doubles, pixels: int) -> Doubles:
    """The continuation of ``sums`` (H, W, C) over ``weights`` (H, W), each a sum over so many
    pixels."""
    height, width = weights.shape
    own = sums / np.maximum(weights, np.finfo(float).tiny)[..., None]
    if max(height, width) == 1:
        return own
    padding = ((0, height % 2), (0, width % 2))
    coarse = _pull_push(
        _halved(np.pad(sums, (*padding, (0, 0)))), _halved(np.pad(weights, padding)), 4 * pixels
    )
    size = width + width % 2, height + height % 2
    smooth = cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR).reshape(*size[::-1], -1)
    known = np.minimum(weights / (SATURATION * pixels), 1.0)[..., None]
    return np.asarray(known * own + (1 - known) * smooth[:height, :width])


def _halved(values: Doubles) -> Doubles:
    """Sums over 2 x 2 pixels of an image of even size."""
    return np.asarray(values[::2, ::2] + values[1::2, ::2] + values[::2, 1::2] + values[1::2, 1::2])


@dataclass(frozen=True)
class PaintCommand:
    """A program that paints holes.

    Attributes:
        words: The program and its arguments, to which the three files are added.
        time_limit_s: The time after which the program and all that it has started are ended.
    """

    words: tuple[str, ...]
    time_limit_s: float = TIME_LIMIT_S

    def __str__(self) -> str:
        return shlex.join(self.words)

    def __call__(self, image: Picture, hole: Bools, weights: Doubles) -> Picture:
        """Run the program.

        Raises:
            UserError: the program is not found, fails, exceeds the time limit, or writes no image
                of this size with 8-bit RGB.
        """
        with TemporaryDirectory(prefix="painting-") as folder:
            files = [Path(folder) / f"{name}.png" for name in ("image", "mask", "output")]
            write_png(files[0], image)
            write_png(files[1], np.where(hole, np.uint8(255), np.uint8(0)))
            with (Path(folder) / "messages").open("w+b") as messages:
                code = self._run(files, messages)
                if code != 0:
                    how = f"exit code {code}" if code > 0 else f"signal {-code}"
                    raise self._error(f"expected it to succeed, found {how}", messages)
                return self._read(files[2], image.shape, messages)

    def _run(self, files: list[Path], messages: IO[bytes]) -> int:
        """The exit code of the program; minus the number of the signal that ended it."""
        try:
            # A session of its own: the program is ended together with all that it has started.
            process = subprocess.Popen(
                [*self.words, *map(str, files)],
                stdin=subprocess.DEVNULL,
                stdout=messages,
                stderr=messages,
                start_new_session=True,
            )
        except OSError as error:
            reason = error.strerror or str(error)
            raise self._error(f"the program cannot be started: {reason}", messages) from None
        try:
            return process.wait(self.time_limit_s)
        except subprocess.TimeoutExpired:
            limit = f"{self.time_limit_s:g} seconds"
            raise self._error(f"expected an image within {limit}, found none", messages) from None
        finally:
            if process.poll() is None:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()

    def _read(self, file: Path, shape: tuple[int, ...], messages: IO[bytes]) -> Picture:
        expected = f"expected {shape[1]}x{shape[0]} pixels of 8-bit RGB in OUTPUT.png, found "
        if not file.is_file():
            raise self._error(f"{expected}no file", messages)
        try:
            # Pillow raises exceptions of many types on damaged files.
            with Image.open(io.BytesIO(file.read_bytes())) as opened:
                found = f"{opened.width}x{opened.height} pixels of mode {opened.mode}"
                if (opened.height, opened.width) != shape[:2] or opened.mode != "RGB":
                    raise self._error(f"{expected}{found}", messages)
                return np.array(opened, np.uint8)
        except UserError:
            raise
        except Exception as error:
            raise self._error(f"{expected}no readable image ({error})", messages) from None

    def _error(self, what: str, messages: IO[bytes]) -> UserError:
        """The error with the last lines that the program wrote."""
        size = messages.seek(0, os.SEEK_END)
        messages.seek(max(0, size - _LAST_BYTES))
        lines = messages.read().decode(errors="replace").strip().splitlines()[-_LAST_LINES:]
        said = "".join(f"\n    {line}" for line in lines)
        said = f"; its last messages:{said}" if said else ""
        return UserError(f"holes.fill: {self}: {what}{said}", fix=_CONTRACT)
