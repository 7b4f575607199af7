"""What a face of a solid looks like: the description from which its texture is painted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Colour = tuple[float, float, float]  # linear RGB albedo

Wall = Literal["plaster", "brick", "boards", "timber", "stone"]
Cover = Literal["tiles", "slates", "gravel"]
Plain = Literal["wood", "hedge", "fence", "bark", "car", "cabin", "metal", "sign"]


@dataclass(frozen=True)
class Finish:
    """The look of a face. Two finishes with the same seed and size are the same picture.

    Attributes:
        kind: material.
        seed: of everything drawn at random.
        colour: main colour.
        accent: colour of doors, shutters and signs.
        eaves: height of a wall below its gable, metres; windows stand below it. 0: no windows.
        door: whether the wall has the house's door.
        shop: a shop window and a sign on the ground floor.
    """

    kind: Wall | Cover | Plain
    seed: int
    colour: Colour
    accent: Colour = (0.2, 0.2, 0.2)
    eaves: float = 0.0
    door: bool = False
    shop: bool = False
