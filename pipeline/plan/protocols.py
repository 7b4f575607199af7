"""How papers measure the scenes of published benchmarks: image folder, size, test views."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

# The common prefixes of scene names.
_PREFIX = re.compile(
    r"^(mip[_-]?(nerf)?[_-]?360|m?360(_v2)?|nerf([_-]synthetic)?|blender|tandt|tnt|t2|db|dtu)[_-]"
)
# The photographs of NeRF-synthetic scenes, without suffix.
_RENDERED = re.compile(r"(train|test|val)/r_\d+")
NUM_SYNTHETIC = {"train": 100, "test": 200}


@dataclass(frozen=True)
class PublishedScene:
    """A scene of a published benchmark, as the papers of 3D Gaussian splatting measure it.

    Attributes:
        benchmark: The name of the data set.
        scene: The name of the scene in lower case.
        photographs: The possible numbers of photographs; empty if ``every`` is None.
        size: The width and height of the views in pixels.
        image_folder: The folder of the photographs that papers use; None if pose files list them.
        every: Every this-many-th view, sorted by name, is a test view; if 0, all views are training
            views and are measured; None if the data set lists its test views.
        num_test: The number of the listed test views; 0 if ``every`` is not None.
        background: The colour behind transparent photographs; None if the photographs are opaque.
    """

    benchmark: str
    scene: str
    photographs: Collection[int]
    size: tuple[int, int]
    image_folder: str | None = "images"
    every: int | None = 8
    num_test: int = 0
    background: Literal["black", "white"] | None = None

    @property
    def title(self) -> str:
        return f"{self.scene} of {self.benchmark}"

    def has(self, photographs: Sequence[str]) -> bool:
        """Whether these may be the scene's photographs, according to their number or names."""
        if self.every is not None:
            return len(photographs) in self.photographs
        stems = [name.rpartition(".")[0] or name for name in photographs]
        return all(map(_RENDERED.fullmatch, stems)) and (
            sum(stem.startswith("train/") for stem in stems) == NUM_SYNTHETIC["train"]
        )


def _mip_nerf_360() -> list[PublishedScene]:
    """Mip-NeRF 360 (Barron et al. 2022) measures outdoor scenes at 1/4 and indoor scenes at 1/2 of
    the size, in the copies that the data set brings, as do 3DGS (its full_eval.py) and later
    papers."""
    outdoor = {
        "bicycle": (194, (1237, 822)),
        "flowers": (173, (1256, 828)),
        "garden": (185, (1297, 840)),
        "stump": (125, (1245, 825)),
        "treehill": (141, (1267, 832)),
    }
    indoor = {
        "bonsai": (292, (1559, 1039)),
        "counter": (240, (1558, 1038)),
        "kitchen": (279, (1558, 1039)),
        "room": (311, (1557, 1038)),
    }
    return [
        PublishedScene("Mip-NeRF 360", name, (count,), size, folder)
        for folder, scenes in (("images_4", outdoor), ("images_2", indoor))
        for name, (count, size) in scenes.items()
    ]


def _released_with_3dgs() -> list[PublishedScene]:
    """The scenes in the data set of Kerbl et al. 2023 (tandt_db.zip). They are narrower than 1600
    pixels, so that 3DGS uses them at their size."""
    scenes = {
        "truck": ("Tanks and Temples", 251, (979, 546)),
        "train": ("Tanks and Temples", 301, (980, 545)),
        "drjohnson": ("Deep Blending", 263, (1332, 876)),
        "playroom": ("Deep Blending", 225, (1264, 832)),
    }
    return [
        PublishedScene(benchmark, name, (count,), size)
        for name, (benchmark, count, size) in scenes.items()
    ]


def _nerf_synthetic() -> list[PublishedScene]:
    """The scenes of NeRF-synthetic (Mildenhall et al. 2020), which are measured on white."""
    names = ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship")
    tested = NUM_SYNTHETIC["test"]
    return [
        PublishedScene("NeRF-synthetic", name, (), (800, 800), None, None, tested, "white")
        for name in names
    ]


def _dtu() -> list[PublishedScene]:
    """The scenes of DTU as Huang et al. 2024 (2DGS) released it, with masks as alpha: they are
    measured at half of the size, by the PSNR of the training views."""
    scans = (24, 37, 40, 55, 63, 65, 69, 83, 97, 105, 106, 110, 114, 118, 122)
    return [
        PublishedScene("DTU", f"scan{n}", (49, 64), (777, 581), every=0, background="black")
        for n in scans
    ]


PUBLISHED_SCENES = {
    scene.scene: scene
    for scene in (*_mip_nerf_360(), *_released_with_3dgs(), *_nerf_synthetic(), *_dtu())
}


def benchmark_scene(folder: str) -> str:
    """The scene's name in lower case without the data set's prefix: mip360_Bonsai -> bonsai.

    A number that gives the size of a copy is no part of the name: nerf_lego_800 -> lego.
    """
    name = _PREFIX.sub("", folder.casefold())
    return re.sub(r"_(400|800)$", "", name)


def recognise(folder: str, photographs: Sequence[str]) -> PublishedScene | None:
    """The published scene that a folder is by its name and its photographs; None for others.

    Args:
        folder: The name of the scene folder.
        photographs: The names of the photographs that are used.
    """
    scene = PUBLISHED_SCENES.get(benchmark_scene(folder))
    return scene if scene is not None and scene.has(photographs) else None
