"""How the photographs of the demo scene are taken: light, exposure, lens and passers-by, which may
differ between photographs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from pipeline.demo.lighting import REFERENCE_LIGHT, Light, lights
from pipeline.geometry.cameras import Camera
from pipeline.runtime.errors import UserError

Array = NDArray[np.float64]
TestViews = Literal["clean", "own"]

# The stops of the exposures, the reference first.
STOPS = (0.0, -0.7, 0.7, -0.35, 0.35, -1.0, 1.0)
# The largest change of a channel by the white balance of an exposure.
BALANCE = 0.1
# Vignetting of the last lens at the corners in stops. Those before have equal parts of it.
MAX_FALLOFF_STOPS = 1.0
# Every so many photographs, sorted by name, is a test view: the default of ``split.test_every``.
TEST_EVERY = 8


@dataclass(frozen=True)
class Conditions:
    """What differs between the photographs of a demo scene. The defaults change nothing.

    Attributes:
        lights: The number of lights: the reference, and others from noon to dusk.
        exposures: The number of exposures, which differ in brightness and white balance.
        lenses: The number of camera bodies, each with a lens of another vignetting; 0 for one
            camera without vignetting.
        ramp: The largest change of exposure in stops over a photograph, in a random direction.
        walkers: The share of the photographs with one to three walking figures.
        withhold: The share of the photographs, neighbours in the ring, that are not in the scene
            but in ``withheld/``, in the reference conditions.
        tests: The conditions of test views: "clean" for the reference, "own" for those of any other
            photograph. Both are without walkers.
    """

    lights: int = 1
    exposures: int = 1
    lenses: int = 0
    ramp: float = 0.0
    walkers: float = 0.0
    withhold: float = 0.0
    tests: TestViews = "own"

    def check(self) -> None:
        """Raises UserError if a value is out of range."""
        if self.lights < 1 or not 1 <= self.exposures <= len(STOPS) or self.lenses < 0:
            raise UserError(f"expected 1 or more lights, 0 or more lenses, 1 to {len(STOPS)} "
                            "exposures")  # fmt: skip
        if not (0 <= self.ramp <= 4 and 0 <= self.walkers <= 1 and 0 <= self.withhold < 1):
            raise UserError("expected a ramp of 0 to 4 stops, and shares between 0 and 1")
        if self.tests not in get_args(TestViews):
            raise UserError(f"unknown test views {self.tests!r}")


@dataclass(frozen=True)
class Shot:
    """The conditions of a photograph.

    Attributes:
        lit: The light of the scene.
        stops: The exposure in stops, relative to the reference.
        balance: The factor of each channel by the white balance.
        ramp: The change of exposure in stops from the left to the right edge, and from the top to
            the bottom edge.
        falloff: The vignetting at the corners in stops.
        body: The number of the camera body; 0 is that of the reference.
        records_exposure: Whether EXIF has the exposure.
        walkers: Whether there are walking figures.
    """

    lit: Light = REFERENCE_LIGHT
    stops: float = 0.0
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    ramp: tuple[float, float] = (0.0, 0.0)
    falloff: float = 0.0
    body: int = 0
    records_exposure: bool = False
    walkers: bool = False


def withheld(conditions: Conditions, views: int, seed: int) -> range:
    """The numbers of the photographs that are not in the scene."""
    count = min(round(conditions.withhold * views), views - 1)
    first = int(np.random.default_rng([seed, 7]).integers(0, views - count + 1))
    return range(first, first + count)


def shots(conditions: Conditions, views: int, seed: int) -> list[Shot]:
    """The conditions of each photograph. Each light, exposure and lens has an equal share of them,
    and a choice of one kind does not depend on the other kinds."""
    arc = withheld(conditions, views, seed)
    kept = [number for number in range(views) if number not in arc]
    tests = {*kept[::TEST_EVERY]}
    differ = conditions.exposures > 1 or conditions.lenses > 0
    reference = Shot(records_exposure=differ)
    lit = lights(conditions.lights, seed)
    light, exposure, lens, ramp, walking = (
        np.random.default_rng([seed, 5, kind]) for kind in range(5)
    )
    light_of, exposure_of, lens_of = (
        rng.permutation(np.arange(views) % max(count, 1)).tolist()
        for rng, count in (
            (light, conditions.lights),
            (exposure, conditions.exposures),
            (lens, conditions.lenses),
        )
    )
    balances = exposure.uniform(1 - BALANCE, 1 + BALANCE, (len(STOPS), 3))
    balances[0] = 1.0
    others = [number for number in kept if number not in tests]
    walked = {*walking.permutation(others)[: round(conditions.walkers * len(others))].tolist()}
    found = []
    for number in range(views):
        slope, angle = ramp.uniform(0.5, 1) * conditions.ramp, ramp.uniform(0, 2 * np.pi)
        if number in arc or (number in tests and conditions.tests == "clean"):
            found.append(reference)
            continue
        across, down = np.cos(angle), np.sin(angle)
        slope /= abs(across) + abs(down)
        body = lens_of[number] + 1 if conditions.lenses else 0
        r, g, b = balances[exposure_of[number]].tolist()
        found.append(
            Shot(
                lit[light_of[number]],
                STOPS[exposure_of[number]],
                (r, g, b),
                (float(slope * across), float(slope * down)),
                MAX_FALLOFF_STOPS * body / max(conditions.lenses, 1),
                body,
                differ,
                number in walked,
            )
        )
    return found


def photographed(light: Array, shot: Shot, camera: Camera) -> Array:
    """(H, W, 3) linear light on the sensor, from that of the scene (``Rendered.light``).

    The vignetting is a power of that of a simple lens, the fourth power of the cosine of the angle
    from the axis.
    """
    fx, fy, cx, cy = camera.pinhole
    x, y = np.arange(camera.width) + 0.5, (np.arange(camera.height) + 0.5)[:, None]
    fourth = np.log2(1 + ((x - cx) / fx) ** 2 + ((y - cy) / fy) ** 2)
    corner = np.log2(1 + (cx / fx) ** 2 + (cy / fy) ** 2)
    stops = shot.stops - shot.falloff * fourth / corner
    stops = stops + shot.ramp[0] * (x / camera.width - 0.5)
    stops = stops + shot.ramp[1] * (y / camera.height - 0.5)
    return np.asarray(light * np.exp2(stops)[..., None] * np.array(shot.balance))
