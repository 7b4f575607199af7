"""The native libraries of the backends, for tools that report on them or compile them beforehand.

Importing this module does not import torch.
"""

from __future__ import annotations

from pipeline.render.cpu import build
from pipeline.runtime.native import NativeLibrary


def native_libraries() -> list[NativeLibrary]:
    """One library for each backend that is compiled.

    Raises:
        UserError: torch is not installed.
    """
    return [build.library()]
