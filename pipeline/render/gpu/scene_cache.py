"""The scene that operators render, on the device."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.render.checks import Parameters
from pipeline.render.gpu import layout
from pipeline.render.gpu.device import Gpu
from pipeline.render.gpu.rasterise import Scene


@dataclass(frozen=True)
class _Entry:
    """A scene on the device, and its tensors, which are kept so that others cannot get their
    addresses."""

    key: object
    scene: Scene
    parameters: Parameters


class SceneCache:
    """The parameters of the last call, since a scene is usually rendered from many views, and those
    that a training has lent."""

    def __init__(self) -> None:
        self._last: _Entry | None = None
        self._lent: _Entry | None = None

    def get(self, gpu: Gpu, parameters: Parameters) -> Scene:
        """The parameters on the device, to which they are copied unless they are there."""
        key = _key(parameters)
        for entry in (self._lent, self._last):
            if entry is not None and entry.key == key:
                return entry.scene
        count, sh = len(parameters[0]), parameters[4]
        scene = Scene(
            count,
            sh.shape[1],
            gpu.upload(layout.join(parameters[:4]), what=f"{count} Gaussians"),
            gpu.upload(sh.numpy(), what="the SH coefficients"),
        )
        self._last = _Entry(key, scene, parameters)
        return scene

    def lend(self, parameters: Parameters, scene: Scene) -> None:
        """Take ``scene`` for these tensors, until ``take_back`` or until they change."""
        self._lent = _Entry(_key(parameters), scene, parameters)

    def take_back(self) -> None:
        """Forget the scene that was lent."""
        self._lent = None


def _key(parameters: Parameters) -> object:
    return tuple((p.data_ptr(), p._version, p.shape) for p in parameters)
