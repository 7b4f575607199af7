"""The values of command line options."""

from __future__ import annotations

import argparse
import re


def picture_size(text: str) -> tuple[int, int]:
    """The width and height from a text WIDTHxHEIGHT."""
    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text)
    if not match:
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT, found {text!r}")
    return int(match[1]), int(match[2])
