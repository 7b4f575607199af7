"""``python -m pipeline.demo FOLDER``: write the demo scene."""

from __future__ import annotations

import argparse
import sys
from dataclasses import fields
from pathlib import Path
from typing import get_args

from pipeline.demo.cameras import LENSES
from pipeline.demo.capture import STOPS, Conditions, TestViews
from pipeline.demo.options import picture_size
from pipeline.demo.write import DemoSpec, Format, Poses, write_demo
from pipeline.runtime.errors import UserError


def main(arguments: list[str] | None = None) -> int:
    default = DemoSpec()
    parser = argparse.ArgumentParser(
        prog="python -m pipeline.demo",
        description="Write the demo scene: photographs of a ray-traced room with exact truth.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("folder", type=Path, help="scene folder to write, for example data/demo")
    add("--views", type=int, default=default.views, help="number of photographs")
    add("--size", type=picture_size, default=f"{default.width}x{default.height}", help="pixels")
    add("--format", choices=get_args(Format), default=default.format)
    add("--distortion", choices=[*LENSES], default=default.distortion, help="the lens")
    add("--poses", choices=get_args(Poses), default=default.poses, help="poses given as input")
    add("--no-points", action="store_true", help="sparse/0 without points")
    add("--alpha", action="store_true", help="objects alone, transparent ground (png)")
    add("--masks", action="store_true", help="a moving ball, and masks that leave it out")
    add("--noise", type=float, default=default.noise, help="read noise of dng, 14-bit steps")
    add("--seed", type=int, default=default.seed, help="another seed, other camera positions")
    add("--processes", type=int, help="number of views rendered at once; None is one per core")
    _add_conditions(parser)
    options = vars(parser.parse_args(arguments))
    folder, processes = options.pop("folder"), options.pop("processes")
    options["width"], options["height"] = options.pop("size")
    options["points"] = not options.pop("no_points")
    conditions = {item.name: options.pop(item.name) for item in fields(Conditions)}
    options["conditions"] = Conditions(**conditions)
    try:
        write_demo(folder, DemoSpec(**options), processes)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _add_conditions(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``Conditions``, by the same names."""
    default = Conditions()
    add = parser.add_argument_group("differences between the photographs").add_argument
    add("--lights", type=int, default=default.lights, help="lights, from noon to dusk")
    add(
        "--exposures",
        type=int,
        default=default.exposures,
        help=f"exposures that differ by up to {max(STOPS)} stops and in white balance",
    )
    add("--lenses", type=int, default=default.lenses, help="camera bodies with vignetting")
    add("--ramp", type=float, default=default.ramp, help="exposure ramp over a photograph, stops")
    add("--walkers", type=float, default=default.walkers, help="share with walking figures")
    add("--withhold", type=float, default=default.withhold, help="share left out, an arc")
    add("--tests", choices=get_args(TestViews), default=default.tests, help="test views' light")


if __name__ == "__main__":
    sys.exit(main())
