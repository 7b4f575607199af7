"""The rooms of the library, lowest layer first: ``python -m tests.rooms`` writes their list
into the design page, ``--check`` compares it."""

from __future__ import annotations

import re
import sys
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "explanation" / "design.md"
_LIST = re.compile(r"<!-- rooms -->.*?<!-- end of rooms -->", re.DOTALL)

#: Room -> what it is for. A room imports only itself and the rooms listed before it.
ROOMS = {
    "runtime": "identity, locks, atomic outputs, progress, errors, isolation, native libraries",
    "config": "schemas of the options, presets, settled options",
    "geometry": "rotations, similarities, cameras with and without distortion, geodesy",
    "scene": "values: photographs, views, manifest, reconstruction, world frame",
    "splats": "Gaussians, initialisation, order",
    "io": "file formats: poses, photographs, masks, depth maps, point clouds, Gaussians",
    "plan": "scan of a scene, plan, budgets of Gaussians and memory",
    "photos": "RAW, frames of videos, panoramas, undistortion, exposure",
    "sfm": "features, matching, mapping, verdict, georeference, check of given poses",
    "mvs": "multi-view stereo: depth maps, filtering, fusion",
    "render": "backend interface, cpu/ (C++), gpu/ (WGSL), float64 reference",
    "training.data": "training images, known depths",
    "training.losses": "losses on colours, alpha and depth",
    "training.optimisers": "Adam for Gaussians and for cameras",
    "training.cameras": "refinement of poses and intrinsics",
    "training.appearance": "exposure gains and appearance embeddings",
    "training.density": "density strategies, removal of floaters",
    "training.few_views": "drop-out and fewer spherical harmonics for few photographs",
    "training.transients": "pixels that only one or few photographs show",
    "training.run": "the settings of a training: options, seed, threads, memory",
    "training.checkpoints": "files that resume a killed run",
    "training.loop": "the optimisation, step by step",
    "training.scene": "entry point: trains a scene and reports on it",
    "training.blocks": "division of large scenes into blocks",
    "metrics": "PSNR, SSIM, FLIP, LPIPS, protocols, pose errors",
    "coverage": "what the photographs did not see",
    "holes": "invented content for places that no photograph shows",
    "surface": "meshes",
    "survey": "maps of georeferenced scenes: surface model, orthophoto, report on accuracy",
    "export": "files for other programs",
    "reporting": "metrics.json, the page of a scene, tables of batches",
    "watching": "the live view of a training",
    "demo": "the demo scene",
}


def page_with_list(page: str) -> str:
    """The page with its list of rooms made anew."""
    width = max(map(len, ROOMS)) + 2
    lines = [f"    {name + '/':{width}} {purpose}" for name, purpose in ROOMS.items()]
    return _LIST.sub(
        lambda _: "\n".join(["<!-- rooms -->", "", *lines, "", "<!-- end of rooms -->"]), page
    )


def main() -> int:
    page = PAGE.read_text()
    new = page_with_list(page)
    if new == page:
        return 0
    if "--check" in sys.argv[1:]:
        print(f"{PAGE}: its list of rooms differs from tests/rooms.py; run python -m tests.rooms")
        return 1
    PAGE.write_text(new)
    return 0


if __name__ == "__main__":
    sys.exit(main())
