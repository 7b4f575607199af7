"""The coverage of a scene by its photographs (``coverage.json``)."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from pipeline.runtime.json_file import JsonFile, JsonObject, Matrix4, Vector3
from pipeline.runtime.text import counted

RENDER = "File of the render, relative to the stage's folder"
TRUST_MAP = "File of the trust of each pixel: grey, 0 to 255 for 0 to 1"

#: Share of contradicted pixels of novel views from which it is part of the summaries.
CONSPICUOUS_SHARE = 0.05


class SeenBy(JsonObject):
    """Shares of the surface, 0 to 1, by the number of training views that see it."""

    one: float = Field(ge=0, le=1, description="Seen by one.")
    two: float = Field(ge=0, le=1, description="Seen by two.")
    three_or_more: float = Field(ge=0, le=1, description="Seen by three or more.")


class SurfaceCoverage(JsonObject):
    """How training views see the surface that a sample of them shows."""

    seen_by: SeenBy = Field(description="Shares of the surface.")
    median_photographs: float = Field(description="Median number of training views of a point.")
    median_parallax_deg: float = Field(
        description="Median over the points of the largest angle between the first view that sees "
        "the point and another one, degrees."
    )


class ViewCoverage(JsonObject):
    """Trust and defects of a test view; shares are of its measured pixels, 0 to 1."""

    name: str = Field(description="The photograph's name.")
    psnr: float = Field(description="PSNR, dB.")
    mean_trust: float | None = Field(
        description="Over the measured pixels, 0 to 1; null if there are none."
    )
    low_trust_share: float = Field(ge=0, le=1, description="Pixels of low trust.")
    hole_share: float = Field(
        ge=0, le=1, description="Pixels that show no surface although there is one."
    )
    floater_share: float = Field(ge=0, le=1, description="Pixels that show floaters.")
    median_photographs: float = Field(
        description="Median number of training views that see the point of a pixel."
    )
    render: str | None = Field(None, description=f"{RENDER}; null unless the page shows the view.")
    trust_map: str | None = Field(None, description=f"{TRUST_MAP}; null as `render`.")


class ErrorClass(JsonObject):
    """The error of blocks whose mean trust is in a range."""

    trust_range: tuple[float, float] = Field(description="Lower and upper bound.")
    share: float = Field(ge=0, le=1, description="Of all blocks.")
    rmse: float = Field(ge=0, description="Root mean square error, for colours in 0..1.")


class ErrorByTrust(JsonObject):
    """How the error of test views depends on trust, over square blocks of pixels."""

    num_blocks: int = Field(ge=0, description="Number of blocks.")
    block_px: int = Field(description="Side of a block, pixels of the trust map.")
    rank_correlation: float | None = Field(
        description="Spearman's, of trust and squared error; null for too few blocks. -1: low "
        "trust always means high error; 0: no relation."
    )
    by_trust: tuple[ErrorClass, ...] = Field(description="Classes that have a block.")


class FloaterCoverage(JsonObject):
    """Opaque Gaussians in front of cameras, nearer than any certain surface."""

    num_gaussians: int = Field(ge=0, description="Number of floaters.")
    search_distance: float = Field(
        ge=0, description="From a camera, world units; 0 if no surface is certain."
    )
    by_camera: dict[str, int] = Field(
        description="Name of a view to the number of floaters that it shows; the views with most."
    )


class NovelKind(JsonObject):
    """Means over the novel views of one kind; shares are of all pixels, 0 to 1."""

    num_views: int = Field(ge=1, description="Number of novel views.")
    contradicted_share: float = Field(
        ge=0, le=1, description="Pixels that contradict the photographs: floaters, veils and haze."
    )
    unseen_share: float = Field(
        ge=0, le=1, description="Other pixels, whose surface no training view sees."
    )


class NovelPlace(JsonObject):
    """A novel view; world to camera in COLMAP's convention, in the scene's frame."""

    kind: str = Field(description="The kind of the view.")
    near: str = Field(description="The name of the training view that was moved.")
    contradicted_share: float = Field(ge=0, le=1, description="Pixels, as in `by_kind`.")
    unseen_share: float = Field(ge=0, le=1, description="Pixels, as in `by_kind`.")
    world_to_camera: Matrix4 = Field(description="4 x 4 by rows.")
    render: str = Field(description=f"{RENDER}.")
    map: str = Field(
        description="File of the render, dimmed, with contradicted pixels orange, unseen ones blue."
    )


class NovelViewCoverage(JsonObject):
    """What views show that stand where no photograph does, compared with the photographs."""

    contradicted_share: float = Field(ge=0, le=1, description="Mean over all novel views.")
    unseen_share: float = Field(ge=0, le=1, description="Mean over all novel views.")
    by_kind: dict[str, NovelKind] = Field(
        description="`between` two cameras; `beside` a camera, by 0.3 of the distance to its "
        "subject; `behind` it, by 0.35; `raised` by 0.3, looking at the same subject. Kinds "
        "without a free place are left out."
    )
    worst: NovelPlace = Field(description="The view with most contradicted pixels.")

    @property
    def is_conspicuous(self) -> bool:
        """Whether the contradictions are worth a word where few figures are shown."""
        return self.contradicted_share >= CONSPICUOUS_SHARE


class Surroundings(JsonObject):
    """Trust around the photographs, over viewpoints from which more could be taken."""

    num_viewpoints: int = Field(ge=0, description="Number of viewpoints.")
    mean_trust: float = Field(description="With the photographs as they are, 0 to 1.")
    mean_trust_with_proposals: float = Field(
        description="With photographs from all proposed viewpoints, 0 to 1."
    )


class ProposedViewpoint(JsonObject):
    """A viewpoint to photograph; world to camera in COLMAP's convention, in the scene's frame."""

    description: str = Field(description="Where it is, relative to existing photographs.")
    position: Vector3 = Field(description="Camera centre, world.")
    direction: Vector3 = Field(description="Viewing direction, unit vector, world.")
    look_at: Vector3 = Field(description="Point of the surface on the optical axis, world.")
    world_to_camera: Matrix4 = Field(description="4 x 4 by rows.")
    unknown_percent: float = Field(
        description="100 (1 - mean trust) of this view, given the proposals before it."
    )
    gain_percent: float = Field(
        description="Trust that the photograph adds, in percent of the trust that is missing "
        "around the photographs, given the proposals before it."
    )
    render: str = Field(description=f"{RENDER}.")
    trust_map: str = Field(description=f"{TRUST_MAP}.")


class CoverageRecord(JsonFile, JsonObject):
    """How well the photographs cover a scene. Trust is 0 to 1 for each pixel of a view."""

    file_name: ClassVar[str] = "coverage.json"

    schema_version: Literal[1] = Field(1, description="Version of this file's format.")
    num_training_views: int = Field(ge=0, description="Training views of the scene.")
    num_rendered_views: int = Field(
        ge=0, description="Training views that were used: all, or an even sample."
    )
    trust_definition: str = Field(description="Definition of trust; a sentence for people.")
    reason: str = Field("", description="Why nothing was measured; empty where it was.")
    surface: SurfaceCoverage | None = Field(
        None, description="null if no surface is seen by a training view."
    )
    views: tuple[ViewCoverage, ...] = Field(
        (), description="Test views, or an even sample of them."
    )
    error: ErrorByTrust | None = Field(None, description="null with a `reason`.")
    floaters: FloaterCoverage | None = Field(None, description="null with a `reason`.")
    novel_views: NovelViewCoverage | None = Field(
        None, description="null with a `reason`, or if there is no free place beside the cameras."
    )
    surroundings: Surroundings | None = Field(None, description="null with a `reason`.")
    viewpoints: tuple[ProposedViewpoint, ...] = Field(
        (), description="In the order in which they raise trust most."
    )

    def headline(self) -> str:
        """What was found, in a few words for the terminal."""
        if self.surface is None:
            return self.reason
        places = f"{counted(len(self.viewpoints), 'place')} to photograph next"
        if self.novel_views is None or not self.novel_views.is_conspicuous:
            return places
        percent = f"{100 * self.novel_views.contradicted_share:.0f} %"
        return f"{places}; {percent} of what one sees beside the photographs contradicts them"
