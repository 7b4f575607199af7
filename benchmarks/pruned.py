"""What a scene loses on its test views when it has fewer Gaussians.

    python -m benchmarks.pruned results/NAME ALL.ply FEWER.ply [...] --json RECORD.json

The files are of one finished scene: all of its Gaussians, as exported, and exports with
``export.max_gaussians``. Each is measured as by ``splatmake evaluate``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.record_tables import pruned_table
from benchmarks.results import PrunedResult
from pipeline.commands import Rendering, evaluate
from pipeline.runtime.machine import usable_cores


def measure(scene: Path, files: Sequence[Path], training: str) -> list[PrunedResult]:
    """Measure files of a scene, the first of which has all Gaussians."""
    how, found = Rendering(None, None, None, usable_cores()), []
    for file in files:
        quality = evaluate(file, scene, None, None, how)
        found.append(
            PrunedResult(
                scene=scene.name,
                training=training,
                gaussians=quality.model.num_gaussians,
                views=quality.protocol.num_views,
                pixels=", ".join(quality.protocol.resolution),
                psnr=quality.psnr,
                ssim=quality.ssim,
            )
        )
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.pruned",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("scene", type=Path, metavar="results/NAME")
    add("files", type=Path, nargs="+", metavar="FILE.ply")
    add("--training", default="", help="how the scene was trained, in a few words")
    add_record_options(parser)
    asked = parser.parse_args(arguments)
    found = measure(asked.scene, asked.files, asked.training)
    print(pruned_table(found))
    if asked.json is not None:
        write_record(asked.json, measured("pruned", asked.note, arguments), found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
