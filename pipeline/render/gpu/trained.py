"""The tensors that training changes, in the memory of the device."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from pipeline.render.gpu import layout
from pipeline.render.gpu.device import Buffer, blocks
from pipeline.render.gpu.rasterise import Scene
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.resident import Optimised, Part

# The parts of the buffers. All others have moments.
PARTS = {
    "geometry": Part.GEOMETRY,
    "statistics": Part.GEOMETRY,
    "sh": Part.PARAMETERS,
    "appearance": Part.PARAMETERS,
    "last": Part.PARAMETERS,
}
BLANK = np.uint32(1 << 31)  # kBlank in take_rows.wgsl


class Trained:
    """Buffers of ``Optimised``.

    Attributes:
        count: The number of Gaussians.
        buffers: The buffers, by name.
        sections: For each buffer, the words of a row of each of its tensors, which lie in it one
            after another.
    """

    def __init__(self, space: Workspace) -> None:
        self.gpu, self.space = space.gpu, space
        self.count = 0
        self.buffers: dict[str, Buffer] = {}
        self.sections: dict[str, dict[str, int]] = {}

    @property
    def scene(self) -> Scene:
        coefficients = self.sections["sh"]["sh"] // 3
        return Scene(self.count, coefficients, self.buffers["geometry"], self.buffers["sh"])

    @property
    def embedding_size(self) -> int:
        """The number of colours of each Gaussian that depend on the photograph."""
        return layout.floats(self.sections.get("appearance", {})) // 3

    def moments_at(self, name: str) -> int:
        """The first element of a section of the buffer of moments."""
        return layout.offsets(self.sections["moments"], self.count)[name][0]

    def load(self, optimised: Optimised, part: Part) -> None:
        """See ``ResidentTraining``."""
        self.count = len(optimised.last)
        for name, tensors in _arrays(optimised, Part.NOTHING, part).items():
            self._replace(name, self.gpu.upload(layout.join(tensors.values()), what=name))
            self.sections[name] = layout.words(tensors)

    def load_moments(self, optimised: Optimised, name: str) -> None:
        """See ``ResidentTraining``."""
        for each, moments in (("first", optimised.first), ("second", optimised.second)):
            at = 4 * self.moments_at(f"{each} {name}")
            self.gpu.write(self.buffers["moments"], moments[name].numpy(), at)

    def store(self, optimised: Optimised, part: Part) -> None:
        """See ``ResidentTraining``."""
        for name, tensors in _arrays(optimised, Part.NOTHING, part).items():
            layout.fetch(self.gpu, self.buffers[name], *tensors.values())

    def select(self, rows: Tensor, blank: Tensor, row: Optimised) -> None:
        """See ``ResidentTraining``."""
        marked = rows.numpy().astype(np.uint32) | np.where(blank.numpy(), BLANK, np.uint32(0))
        order = self.gpu.upload(marked, what="rows")
        for name, tensors in _arrays(row, Part.GEOMETRY, Part.ALL).items():
            taken = self._taken(name, order, len(rows), tensors)
            self._replace(name, taken)
            self.sections[name] = layout.words(tensors)
            self.gpu.read(order, np.uint32, 1)  # Waits: one array at a time is there twice.
        self.count = len(rows)

    def bad_colors(self) -> Tensor:
        """See ``ResidentTraining``."""
        found = self.gpu.empty(4 * self.count, what="rows that are not finite")
        for name in self.buffers.keys() & {"sh", "appearance"}:
            self.gpu.run(
                "not_finite", blocks(self.count), values=self.buffers[name], found=found,
                size=self.gpu.uniform("II", self.count, layout.floats(self.sections[name])),
            )  # fmt: skip
        return torch.from_numpy(self.gpu.read(found, np.uint32, self.count) != 0)

    def _taken(self, name: str, order: Buffer, count: int, blank: Mapping[str, Tensor]) -> Buffer:
        """A new buffer with rows of another one.

        Args:
            order: (count,) uint32, as of take_rows.wgsl.
            blank: A row of each of the tensors, which marked rows of moments are copies of.
        """
        gpu, before, after = self.gpu, self.sections[name], layout.words(blank)
        sources = layout.offsets(before, self.count)
        results, blanks = layout.offsets(after, count), layout.offsets(after, 1)
        result = gpu.empty(4 * layout.floats(after) * count, what=name)
        row = gpu.upload(layout.join(blank.values()), what="a row")
        for each, width in after.items():
            numbers = count, width, before[each], sources[each][0], blanks[each][0]
            gpu.run(
                "take_rows", blocks(width * count), rows=order, source=self.buffers[name],
                size=gpu.uniform("7I", *numbers, results[each][0], name not in PARTS),
                blank=row, result=result,
            )  # fmt: skip
        return result

    def _replace(self, name: str, buffer: Buffer) -> None:
        self.space.release_groups()
        self.buffers[name] = buffer


def _arrays(optimised: Optimised, after: Part, up_to: Part) -> dict[str, Mapping[str, Tensor]]:
    """The tensors that lie one after another in each buffer, by the names of the buffers, of the
    parts after one up to another."""
    parameters, first, second = optimised.parameters, optimised.first, optimised.second
    found: dict[str, Mapping[str, Tensor]] = {
        "geometry": {name: parameters[name] for name in layout.GEOMETRY},
        "moments": layout.moments(first, second),
        "first sh": {"sh": first["sh"]},
        "second sh": {"sh": second["sh"]},
        "last": {"last": optimised.last},
        "statistics": {name: vars(optimised)[name] for name in layout.STATISTICS},
    }
    if (appearance := parameters.get("appearance")) is not None:
        moments = {"first": first["appearance"], "second": second["appearance"]}
        found |= {"appearance": {"": appearance}, "moments of the appearance": moments}
    found["sh"] = {"sh": parameters["sh"]}  # The last: the old scene keeps it while rows are taken.
    return {k: v for k, v in found.items() if after < PARTS.get(k, Part.ALL) <= up_to}
