"""The Python API: load a result, render views, measure quality.

import splatmake

scene = splatmake.load("results/garden")
print(scene.measure().psnr)
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.config.schema import Evaluate, Train
from pipeline.io import splat_files
from pipeline.io.appearance_files import read_appearance
from pipeline.io.camera_files import choose_views
from pipeline.metrics.evaluate import evaluate_views
from pipeline.metrics.image import psnr, ssim
from pipeline.metrics.protocol import Protocol, choose_protocol
from pipeline.photos.load import load_view
from pipeline.plan.posed_scene import PosedScene, posed_scene
from pipeline.render.views import Render, render_view
from pipeline.runtime.errors import UserError
from pipeline.runtime.machine import usable_cores
from pipeline.scene.appearance import Appearance
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians

__all__ = [
    "Gaussians",
    "Quality",
    "Render",
    "Scene",
    "UserError",
    "View",
    "load",
    "psnr",
    "read_gaussians",
    "ssim",
    "write_gaussians",
]


@dataclass(frozen=True)
class Quality:
    """Image quality of renders, as in metrics.json.

    Attributes:
        psnr: The PSNR in dB.
        flip: The mean FLIP error, 0 to 1.
        lpips: The LPIPS, or None if its weights are not installed.
        views: The quality of each view by its name; empty for a single view.
    """

    psnr: float
    ssim: float
    flip: float | None
    lpips: float | None
    views: dict[str, Quality]


class Scene:
    """Gaussians with views and photographs of the same scene.

    Args:
        gaussians: The model.
        posed: The views, and the settings that the scene was trained with.
        threads: The number of threads for rendering, which does not affect results.
        appearance: How these Gaussians look in each photograph, or None if it is not modelled.

    Attributes:
        gaussians: The model, which can be replaced.
        views: All views, sorted by name.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        posed: PosedScene,
        threads: int,
        appearance: Appearance | None = None,
    ):
        self.gaussians = gaussians
        self.views: list[View] = posed.views
        self._train: Train = posed.train
        self._protocol: Protocol = choose_protocol(posed.views, posed.split, posed.train)
        self._gains = posed.gains
        self._loaded, self._appearance = gaussians, appearance
        self._threads = threads

    @property
    def test_views(self) -> list[View]:
        """The test views, which are not used for training. There may be none."""
        return [view for view in self.views if view.is_test]

    def view(self, name: str) -> View:
        """The view with this name, which may omit the suffix.

        Raises:
            UserError: There is no such view.
        """
        return choose_views(self.views, [name], Path(name))[0]

    def render(self, view: View) -> Render:
        """Render colours, opacity and depth of a view, without exposure gains.

        Args:
            view: One of ``views``, or a modified copy (``dataclasses.replace``).
        """
        return render_view(self.gaussians, view, self._protocol.options(self._train, self._threads))

    def photograph(self, view: View) -> NDArray[np.float32]:
        """The photograph of a view at the view's size, (H, W, 3) float32 in [0, 1].

        Raises:
            UserError: The photograph's file is missing or cannot be read.
        """
        pixels = load_view(view)
        return pixels.over(self._protocol.background).astype(np.float32) / np.float32(255)

    def measure(self, views: Sequence[View] = ()) -> Quality:
        """Render views and compare them with their photographs, with the protocol of metrics.json.

        Args:
            views: The views to measure; empty: the test views, or all views if there are no test
                views.

        Raises:
            UserError: A photograph cannot be read, or its mask leaves no pixel.
        """
        protocol = replace(
            self._protocol, views=list(views) or self._protocol.views, training_views=[]
        )
        with tempfile.TemporaryDirectory() as renders:
            found = evaluate_views(
                self.gaussians,
                protocol,
                Evaluate(),
                self._train,
                Path(renders),
                gains=self._gains,
                # The appearance of other Gaussians is not known.
                appearance=self._appearance if self.gaussians is self._loaded else None,
                threads=self._threads,
            )
        _warn(found.warnings)
        single = {
            view.name: Quality(view.psnr, view.ssim, view.flip, view.lpips, {})
            for view in found.per_view
        }
        return Quality(found.psnr, found.ssim, found.flip, found.lpips, single)


def load(
    folder: str | PathLike[str],
    model: str | PathLike[str] | None = None,
    *,
    max_side: int | None = None,
    threads: int | None = None,
) -> Scene:
    """Load a finished scene (``results/NAME``), or a scene folder with poses and a model.

    Args:
        folder: The finished scene; or photographs with poses and without lens distortion.
        model: The file of Gaussians; None: those of the finished scene.
        max_side: The longer side to which larger views are reduced, in pixels; None: as in the
            finished scene, else full size.
        threads: The number of threads for rendering; None: one per core.

    Raises:
        UserError: A scene or a file is missing, unfinished or unreadable.
    """
    folder = Path(folder)
    file = folder / "train" / "gaussians.npz" if model is None else Path(model)
    posed = posed_scene(folder, max_side, None, exported=splat_files.is_exported(file))
    if model is None and not file.is_file():
        raise UserError(
            "expected a finished scene (results/NAME), found no train/gaussians.npz",
            file=folder,
            fix="give the file of Gaussians as model, or train the scene: "
            f"snakemake --cores all {folder}/metrics.json",
        )
    _warn(posed.warnings)
    gaussians = read_gaussians(file)
    appearance = None if model is not None else read_appearance(file.parent, len(gaussians))
    return Scene(gaussians, posed, threads or usable_cores(), appearance)


def read_gaussians(file: str | PathLike[str]) -> Gaussians:
    """Read Gaussians from a .ply, .spz, .splat, .glb or .npz file.

    Raises:
        UserError: The suffix is unknown, or the file cannot be read.
    """
    found: list[str] = []
    gaussians = splat_files.read_gaussians(Path(file), found)
    _warn(found)
    return gaussians


def write_gaussians(file: str | PathLike[str], gaussians: Gaussians) -> None:
    """Write Gaussians in the format of the file's suffix. A warning names what the format does not
    hold.

    Raises:
        UserError: The suffix is unknown, or the format cannot hold the Gaussians.
    """
    _warn(splat_files.write_gaussians(Path(file), gaussians))


def _warn(messages: Sequence[str]) -> None:
    for message in messages:
        warnings.warn(message, stacklevel=3)
