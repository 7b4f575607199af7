"""``python -m benchmarks.files results/NAME``: size, loss and time of each format of Gaussians.

Writes the exported Gaussians of finished scenes in each format, of SH degree 0 and of their own,
and renders four of their views from each file as it is read, against renders of the PLY file.
``--other FILE`` measures a file that another program wrote of the last scene's PLY file.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.record_tables import files_table
from benchmarks.results import FileResult
from pipeline.export.losses import measure_losses
from pipeline.io.camera_files import read_cameras
from pipeline.io.frame_json import Frame
from pipeline.io.splat_files import read_gaussians, write_gaussians
from pipeline.render import RasterOptions
from pipeline.scene.views import camera_views
from pipeline.splats.arrays import GaussianArrays

FORMATS = {"ply": ".ply", "spz": ".spz", "spz4": ".spz", "sog": ".sog", "splat": ".splat"}
OURS = "splatmake"
# The longer side of the renders, pixels.
SIDE = 640


class Bench:
    """A scene whose files are measured.

    Attributes:
        gaussians: The exported Gaussians.
        views: The views that are rendered.
    """

    def __init__(self, folder: Path) -> None:
        self.name = folder.name
        self.gaussians = read_gaussians(folder / "export" / "point_cloud.ply", []).as_arrays()
        frame = Frame.read(folder / "export").render
        self.options = RasterOptions(
            background=frame.background, near=frame.near, antialias=frame.antialias
        )
        cameras = read_cameras(folder / "export" / "transforms.json", exported=True)
        self.views = camera_views(cameras, SIDE)

    def written(self, name: str, sh_degree: int, folder: Path) -> FileResult:
        """A format, measured."""
        gaussians = self.of_degree(sh_degree)
        file = folder / f"{name}{FORMATS[name]}"
        started = time.process_time()
        write_gaussians(file, gaussians, spz_version=4 if name == "spz4" else 3)
        return self.measured(file, name, OURS, sh_degree, time.process_time() - started)

    def measured(
        self, file: Path, name: str, writer: str, sh_degree: int, cpu_s: float | None = None
    ) -> FileResult:
        """A file of the scene, measured."""
        reduced = self.of_degree(sh_degree)
        (loss,) = measure_losses([file], reduced, self.views, self.options)
        return FileResult(
            scene=self.name,
            gaussians=len(reduced),
            sh_degree=sh_degree,
            format=name,
            writer=writer,
            size_mb=loss.size_mb,
            psnr=round(loss.psnr, 2),
            cpu_s=None if cpu_s is None else round(cpu_s, 2),
        )

    def of_degree(self, sh_degree: int) -> GaussianArrays:
        width = (sh_degree + 1) ** 2
        arrays = self.gaussians.arrays()
        return GaussianArrays(**arrays | {"sh": arrays["sh"][:, :width].copy()})


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="+", metavar="results/NAME")
    parser.add_argument(
        "--other", type=Path, action="append", default=[], metavar="FILE", help="another file"
    )
    parser.add_argument("--writer", default="another program", help="the program that wrote it")
    add_record_options(parser)
    args = parser.parse_args()
    found = []
    for folder in args.folders:
        bench = Bench(folder)
        for degree in sorted({0, bench.gaussians.sh_degree}):
            with TemporaryDirectory() as made:
                for name in FORMATS:
                    found.append(bench.written(name, degree, Path(made)))
    for file in args.other:
        degree = read_gaussians(file, []).sh_degree
        found.append(bench.measured(file, file.suffix[1:], args.writer, degree))
    print(files_table(found))
    if args.json:
        write_record(args.json, measured("files", args.note), found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
