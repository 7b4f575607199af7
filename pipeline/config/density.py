"""Options of the density strategies, which add and remove Gaussians during training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from pipeline.config.section import MAX_FACTOR, GaussianCount, Section, Unit


class DensityControl(Section):
    """Options of every density strategy."""

    pixels_per_gaussian: (
        Literal["auto"] | Annotated[float, Field(ge=0.001, le=MAX_FACTOR), Unit("pixels")]
    ) = Field(
        "auto",
        description="Limits the number of Gaussians to the pixels of one view divided by this, "
        "or to fewer with few photographs or a short budget_minutes. auto: 2; 0.5 with "
        "budget_minutes; no such limit for strategy: original.",
    )
    max_gaussians: GaussianCount = Field(
        1_000_000, description="Upper limit of the number of Gaussians."
    )


class FloaterRemoval(DensityControl):
    """Options of the strategies that remove floaters."""

    remove_floaters: bool = Field(
        True,
        description="Remove Gaussians that are close to one camera, or to a hundredth of the "
        "cameras, which has most of their weight: at less than half the depth of its nearest "
        "sparse points. Only in runs of at least 50 epochs. At the end of any run, remove those "
        "that would hide a view from between two neighbouring cameras, or from a free place "
        "beside, behind or above one.",
    )


class Gradient(FloaterRemoval):
    """Split Gaussians with large gradients, under a limit (after Kerbl et al. 2023)."""

    strategy: Literal["gradient"] = "gradient"


class Mcmc(FloaterRemoval):
    """3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024)."""

    strategy: Literal["mcmc"] = "mcmc"


class Original(DensityControl):
    """Adaptive density control as published (Kerbl et al. 2023, section 5.2)."""

    strategy: Literal["original"] = "original"
    max_gaussians: GaussianCount = Field(
        3_000_000, description="Upper limit of the number of Gaussians."
    )


def _default_strategy(value: Any) -> Any:
    """Options without a strategy are those of ``gradient``."""
    if isinstance(value, Mapping) and "strategy" not in value:
        return {"strategy": "gradient", **value}
    return value


Density = Annotated[
    Gradient | Mcmc | Original, Field(discriminator="strategy"), BeforeValidator(_default_strategy)
]
