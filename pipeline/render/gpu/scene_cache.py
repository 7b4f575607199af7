"""The scene that operators render, on the device."""

from __future__ import annotations

from pipeline.render.checks import Parameters
from pipeline.render.gpu import layout
from pipeline.render.gpu.device import Gpu
from pipeline.render.gpu.rasterise import Scene


class SceneCache:
    """The parameters of the last call: usually, a scene is rendered from many views."""

    def __init__(self) -> None:
        self._last: tuple[object, Scene, Parameters] | None = None

    def get(self, gpu: Gpu, parameters: Parameters) -> Scene:
        """The parameters on the device, to which they are copied once."""
        if self._last is None or self._last[0] != _key(parameters):
            count, sh = len(parameters[0]), parameters[4]
            scene = Scene(
                count,
                sh.shape[1],
                gpu.upload(layout.join(parameters[:4]), what=f"{count} Gaussians"),
                gpu.upload(sh.numpy(), what="the SH coefficients"),
            )
            self.put(parameters, scene)
            return scene
        return self._last[1]

    def put(self, parameters: Parameters, scene: Scene) -> None:
        """Take ``scene`` for these tensors, until they change."""
        # The tensors are kept, so that others cannot get their addresses.
        self._last = _key(parameters), scene, parameters

    def clear(self) -> None:
        """Forget the scene."""
        self._last = None


def _key(parameters: Parameters) -> object:
    return tuple((p.data_ptr(), p._version, p.shape) for p in parameters)
