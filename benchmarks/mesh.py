"""``python -m benchmarks.mesh``: accuracy of the mesh of the demo scene against its true surface.

make demo && python -m benchmarks.mesh results/demo data/demo
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.results import MeshResult
from benchmarks.surface import align, measure, true_points
from pipeline.config.schema import Split, Train, Views
from pipeline.io.colmap import read_model
from pipeline.io.npz import read_npz
from pipeline.metrics.protocol import choose_protocol
from pipeline.runtime.errors import UserError
from pipeline.runtime.memory import peak_memory_mb
from pipeline.runtime.record import read_stage
from pipeline.scene.manifest import Manifest
from pipeline.scene.views import load_views
from pipeline.surface.depth import DepthMaps, RenderCache
from pipeline.surface.mesh import build_mesh


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mesh", description=__doc__)
    parser.add_argument("results", type=Path, help="the demo's results, for example results/demo")
    parser.add_argument("data", type=Path, help="the demo scene, for example data/demo")
    parser.add_argument("--voxel", type=float, help="as export.mesh_voxel")
    parser.add_argument("--threads", type=int, default=2)
    add_record_options(parser)
    options = parser.parse_args()
    sections = read_stage(options.results / "train").key["config"]
    split = Split.model_validate(sections["split"])
    train = Train.model_validate(sections["train"])
    pinhole = options.results / "undistort"
    views = load_views(
        Manifest.read(pinhole / "images.json"),
        read_model(pinhole / "sparse" / "0"),
        Views.model_validate(sections["views"]),
        split,
    )
    gaussians = read_npz(options.results / "train" / "gaussians.npz")
    raster = choose_protocol(views, split, train).options(train, options.threads)
    start, cpu = time.monotonic(), time.process_time()
    with TemporaryDirectory() as folder:
        renders = RenderCache(gaussians, views, raster, Path(folder))
        mesh, grid = build_mesh(DepthMaps(renders), options.voxel, options.threads)
    seconds = {"wall": time.monotonic() - start, "cpu": time.process_time() - cpu}
    peak = peak_memory_mb()
    if mesh is None or grid is None:
        print("no mesh: the depth maps of the views contain no common surface", file=sys.stderr)
        return 1
    frame = align(views, read_model(options.data / "sparse_gt"))
    found = measure(mesh.vertices, mesh.faces, true_points(views, frame), frame)
    result = MeshResult(
        triangles=len(mesh.faces),
        voxel_m=float(grid.voxel * frame.scale),
        voxels=len(grid.blocks) * 512,
        seconds=seconds,
        peak_mb=peak,
        **found,
    )
    print(json.dumps(asdict(result), indent=2))
    if options.json:
        write_record(options.json, measured("mesh", options.note), [result])
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UserError as error:
        sys.exit(f"error: {error}")
