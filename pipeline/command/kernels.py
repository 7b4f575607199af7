"""``python -m pipeline.command.kernels FOLDER``: make the native libraries of a wheel.

Compiles the libraries for all instruction-set targets of this architecture, unless they are
cached, and copies them into the folder.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from pipeline.mvs import patchmatch
from pipeline.render.registry import native_libraries
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError
from pipeline.runtime.native import build_targets
from pipeline.sfm import nearest


def main(folder: Path) -> int:
    try:
        built = [
            item
            for library in (*native_libraries(), nearest.LIBRARY, patchmatch.LIBRARY)
            for item in build_targets(library, ["all"])
        ]
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USER_ERROR
    for item in built:
        shutil.copytree(item.path.parent, folder / item.path.parent.name, dirs_exist_ok=True)
        print(f"{item.path.name} for {item.target}, by {item.compiler}")
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
