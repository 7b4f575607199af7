"""``python -m benchmarks.town FOLDER``: write the synthetic town."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import get_args

from benchmarks.town.write import LENS_CHOICES, Order, TownSpec, write_town
from pipeline.demo.options import picture_size
from pipeline.demo.output import Poses
from pipeline.runtime.errors import UserError


def main(arguments: list[str] | None = None) -> int:
    default = TownSpec()
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.town",
        description="Write a synthetic town: photographs of its streets and of flights over them, "
        "with exact cameras and depths. Its area grows with the number of photographs.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("folder", type=Path, help="scene folder to write, for example data/town")
    add("--photographs", type=int, default=default.photographs, help="number of photographs")
    add("--size", type=picture_size, default=f"{default.width}x{default.height}", help="pixels")
    add("--distortion", choices=LENS_CHOICES, default=default.distortion, help="the lens")
    add(
        "--order",
        choices=get_args(Order),
        default=default.order,
        help="names and times of the photographs: along the camera path, or at random",
    )
    add("--poses", choices=get_args(Poses), default=default.poses, help="poses given as input")
    add("--seed", type=int, default=default.seed, help="another seed, another town")
    add("--processes", type=int, help="photographs rendered at once; None is one per core")
    options = vars(parser.parse_args(arguments))
    folder, processes = options.pop("folder"), options.pop("processes")
    options["width"], options["height"] = options.pop("size")
    try:
        write_town(folder, TownSpec(**options), processes)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
