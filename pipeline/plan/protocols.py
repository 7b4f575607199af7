"""Scenes of published benchmarks, known by their folder's name, and how papers use them."""

from __future__ import annotations

import re

# Mip-NeRF 360 (Barron et al. 2022) evaluates outdoor scenes at a quarter and indoor scenes at half
# of the size; 3DGS and what follows it do the same (its full_eval.py).
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

# What people put before a scene's name in a folder's name.
_PREFIX = re.compile(
    r"^(mip[_-]?(nerf)?[_-]?360|m?360(_v2)?|nerf([_-]synthetic)?|blender|tandt|tnt|t2|db)[_-]"
)


def benchmark_scene(folder: str) -> str:
    """The scene's name without case and the data set's prefix: mip360_Bonsai -> bonsai."""
    return _PREFIX.sub("", folder.casefold())
