"""How papers measure the scenes of published benchmarks: image folder, size, test views."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

# The common prefixes of scene names.
_PREFIX = re.compile(
    r"^(mip[_-]?(nerf)?[_-]?360|m?360(_v2)?|(nerf[_-])?llff([_-]data)?|nerf([_-]synthetic)?|"
    r"blender|tandt|tnt|t2|db|dtu)[_-]"
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
        photographs: The possible numbers of photographs; empty if the scene is identified by the
            names of its photographs.
        size: The width and height of the views in pixels.
        image_folder: The folder of the photographs that papers use; None if pose files list them.
        every: Every this-many-th view, sorted by name, is a test view; if 0, all views are training
            views and are measured; None if the test views are listed.
        num_test: The number of test views; 0 if ``every`` alone decides.
        background: The colour behind transparent photographs; None if the photographs are opaque.
        train_views: The number of training views of papers on few views; None if all views that
            are no test views are training views.
        training, testing: The training and test views that those papers list, by name without
            suffix or, for scenes with a number of ``photographs``, by index in the order of names.
            Empty if ``every`` decides and the training views are evenly spaced among the others.
        deviation: What every run of this program does otherwise than the papers; may be empty.
    """

    benchmark: str
    scene: str
    photographs: Collection[int]
    size: tuple[int, int]
    image_folder: str | None = "images"
    every: int | None = 8
    num_test: int = 0
    background: Literal["black", "white"] | None = None
    train_views: int | None = None
    training: tuple[str | int, ...] = ()
    testing: tuple[str | int, ...] = ()
    deviation: str = ""

    @property
    def title(self) -> str:
        return scene_title(self.scene, self.benchmark, self.train_views)

    def has(self, photographs: Sequence[str]) -> bool:
        """Whether these may be the scene's photographs, according to their number or names."""
        if self.photographs:
            return len(photographs) in self.photographs
        stems = [_stem(name) for name in photographs]
        return all(map(_RENDERED.fullmatch, stems)) and (
            sum(stem.startswith("train/") for stem in stems) == NUM_SYNTHETIC["train"]
        )

    def listed(self, photographs: Sequence[str]) -> tuple[set[str], set[str]]:
        """The names of the listed training and test views among the scene's photographs."""
        names: dict[str | int, str] = {_stem(name): name for name in photographs}
        names |= dict(enumerate(sorted(photographs)))
        training, testing = (
            {names[view] for view in views if view in names}
            for views in (self.training, self.testing)
        )
        return training, testing


def scene_title(scene: str, benchmark: str, train_views: int | None) -> str:
    """The words for a published scene: "fern of LLFF with 3 training views"."""
    few = "" if train_views is None else f" with {train_views} training views"
    return f"{scene} of {benchmark}{few}"


def _stem(name: str) -> str:
    return name.rpartition(".")[0] or name


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


def _llff_few() -> list[PublishedScene]:
    """LLFF (Mildenhall et al. 2019) with few training views, as RegNeRF (Niemeyer et al. 2022)
    measures it: google-research, regnerf/internal/datasets.py and configs/llff3.gin. FreeNeRF,
    SparseNeRF, FSGS, CoR-GS and DropGaussian do the same."""
    counts = {"fern": 20, "flower": 34, "fortress": 42, "horns": 62}
    counts |= {"leaves": 26, "orchids": 25, "room": 41, "trex": 55}
    return [
        _evenly("LLFF", name, (count, (504, 378)), train_views)
        for name, count in counts.items()
        for train_views in (3, 6, 9)
    ]


def _mip_nerf_360_few() -> list[PublishedScene]:
    """The seven scenes of Mip-NeRF 360 that FSGS (Zhu et al. 2024; tools/colmap_360.py and
    arguments/__init__.py) measures at 1/8 of the size with 24 training views, and DropGaussian
    (Park et al. 2025; README.md) with 12 and 24. CoR-GS uses 1/4 of the size."""
    scenes = {
        "bicycle": (194, (618, 411)),
        "garden": (185, (648, 420)),
        "stump": (125, (622, 413)),
        "bonsai": (292, (390, 260)),
        "counter": (240, (389, 260)),
        "kitchen": (279, (389, 260)),
        "room": (311, (389, 259)),
    }
    return [
        _evenly("Mip-NeRF 360", name, facts, train_views)
        for name, facts in scenes.items()
        for train_views in (12, 24)
    ]


def _evenly(
    benchmark: str, scene: str, facts: tuple[int, tuple[int, int]], train_views: int
) -> PublishedScene:
    """A scene of which every 8th view is a test view, and evenly spaced others are training views.

    Args:
        facts: The number of photographs, and the size of those in images_8.
    """
    count, size = facts
    return PublishedScene(
        benchmark, scene, (count,), size, "images_8", 8, -(-count // 8), train_views=train_views
    )


def _nerf_synthetic_few() -> list[PublishedScene]:
    """NeRF-synthetic with 8 training views at half of the size, and every 8th of the 200 test
    views, as CoR-GS (Zhang et al. 2024; scene/dataset_readers.py), DNGaussian and DropGaussian
    measure it. DietNeRF (Jain et al. 2021) drew these training views, but with 75 in place of 76.
    """
    training = tuple(f"train/r_{i}" for i in (2, 16, 26, 55, 73, 76, 86, 93))
    testing = tuple(f"test/r_{i}" for i in range(0, NUM_SYNTHETIC["test"], 8))
    return [
        replace(
            scene,
            size=(400, 400),
            num_test=len(testing),
            train_views=len(training),
            training=training,
            testing=testing,
        )
        for scene in _nerf_synthetic()
    ]


def _dtu_few() -> list[PublishedScene]:
    """DTU with few training views, as RegNeRF measures it at 1/4 of the size: its order of training
    views, and the scans and views of pixelNeRF (google-research, regnerf/internal/datasets.py and
    eval.py; CoR-GS, scripts/run_dtu.py)."""
    scans = (8, 21, 30, 31, 34, 38, 40, 41, 45, 55, 63, 82, 103, 110, 114)
    training = (25, 22, 28, 40, 44, 48, 0, 8, 13)
    unused = {*range(3, 8), *range(16, 22), *range(36, 40)}
    testing = tuple(i for i in range(49) if i not in unused and i not in training)
    return [
        PublishedScene(
            *("DTU", f"scan{scan}", (49, 64), (400, 300)),
            every=None,
            num_test=len(testing),
            train_views=train_views,
            training=training[:train_views],
            testing=testing,
            deviation="whole images are measured, not the object inside of its mask",
        )
        for scan in scans
        for train_views in (3, 6, 9)
    ]


_SCENES = (
    *(*_mip_nerf_360(), *_released_with_3dgs(), *_nerf_synthetic(), *_dtu()),
    *(*_llff_few(), *_mip_nerf_360_few(), *_nerf_synthetic_few(), *_dtu_few()),
)
PUBLISHED_SCENES = {scene.title: scene for scene in _SCENES}


def benchmark_scene(folder: str) -> str:
    """The scene's name in lower case without the data set's prefix: mip360_Bonsai -> bonsai.

    A number that gives the size of a copy is no part of the name: nerf_lego_800 -> lego.
    """
    name = _PREFIX.sub("", folder.casefold())
    return re.sub(r"_(400|800)$", "", name)


def published_as(folder: str) -> list[PublishedScene]:
    """The published scenes with the name of a folder, one for each benchmark and number of
    training views."""
    name = benchmark_scene(folder)
    return [scene for scene in PUBLISHED_SCENES.values() if scene.scene == name]


def recognise(
    folder: str, photographs: Sequence[str], train_views: int | None = None
) -> PublishedScene | None:
    """The published scene that a folder is by its name and its photographs; None for others.

    Args:
        folder: The name of the scene folder.
        photographs: The names of its photographs, of those too that ``split.train_views`` leaves
            out.
        train_views: The value of ``split.train_views``. A number that no paper uses gives the scene
            with all training views, if there is one.
    """
    found = {s.train_views: s for s in published_as(folder) if s.has(photographs)}
    return found.get(train_views) or found.get(None)
