"""Scenes of published benchmarks, recognised by folder name, and the image sizes papers use."""

from __future__ import annotations

import re

# Mip-NeRF 360 (Barron et al. 2022) evaluates outdoor scenes at 1/4 and indoor scenes at 1/2 of the
# size, as do 3DGS (its full_eval.py) and later papers.
MIP_NERF_360 = {
    "bicycle": "images_4",
    "flowers": "images_4",
    "garden": "images_4",
    "stump": "images_4",
    "treehill": "images_4",
    "bonsai": "images_2",
    "counter": "images_2",
    "kitchen": "images_2",
    "room": "images_2",
}

# Common prefixes of scene names.
_PREFIX = re.compile(
    r"^(mip[_-]?(nerf)?[_-]?360|m?360(_v2)?|nerf([_-]synthetic)?|blender|tandt|tnt|t2|db)[_-]"
)


def benchmark_scene(folder: str) -> str:
    """The scene's name in lower case without the data set's prefix: mip360_Bonsai -> bonsai."""
    return _PREFIX.sub("", folder.casefold())
