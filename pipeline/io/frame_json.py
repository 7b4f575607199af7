"""``frame.json``: axes, unit, up direction and render settings of exported Gaussians, which their
file formats do not store."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.runtime.json_file import JsonFile, JsonObject, Vector3
from pipeline.scene.georeference import GIVEN_UNIT, METHODS, Georeference, Method, Origin
from pipeline.scene.views import View, scene_extent
from pipeline.splats.arrays import GaussianSource

AXES = (
    "right-handed, COLMAP's convention: in a camera at the identity, x is right, y is down and z "
    "is forward"
)
_SPZ = "rotated by 180 degrees about x (y and z negated), because SPZ is right, up, back"
OTHER_AXES = {
    "point_cloud.spz": _SPZ,
    "point_cloud_v4.spz": _SPZ,
    "point_cloud.glb": "rotated by 180 degrees about z (x and y negated), because glTF is y up",
    "transforms.json": "camera axes are OpenGL's (x right, y up, z backward)",
}


class RenderSettings(JsonObject):
    """The settings that the Gaussians must be rendered with."""

    background: Vector3 = Field(description="RGB in 0..1.")
    near: float = Field(gt=0, description="Near plane, world units.")
    antialias: bool = Field(description="Mip-Splatting's opacity compensation.")


class FrameCameras(JsonObject):
    """The cameras of all views."""

    count: int = Field(ge=1, description="Number of cameras.")
    centre: Vector3 = Field(description="Mean of the camera centres, world.")
    extent: float = Field(description="Radius of the scene, world units.")


class FrameGaussians(JsonObject):
    """The exported Gaussians."""

    count: int = Field(ge=0, description="Number of Gaussians.")
    sh_degree: int = Field(ge=0, le=3, description="Degree of the spherical harmonics.")
    num_invented: int = Field(
        0,
        ge=0,
        description="Number of invented Gaussians (holes.fill), the last ones of each file.",
    )


class FrameGeoreference(JsonObject):
    """Source and origin of the world frame, as in `georeference.json`."""

    method: Method = Field(description=METHODS)
    origin: Origin | None = Field(
        description="Where the frame's origin is; null for a level frame."
    )
    projection: str | None = Field(
        description="First line of `gcp_list.txt`; null without ground control points."
    )


class Frame(JsonFile, JsonObject):
    """The frame of the exported files."""

    file_name: ClassVar[str] = "frame.json"

    schema_version: Literal[1] = Field(1, description="Version of this file's format.")
    axes: str = Field(description="Of the world.")
    axes_of: dict[str, str] = Field(description="File to its axes, if they differ from `axes`.")
    up: Vector3 = Field(description="Unit vector, world.")
    unit: str = Field(description="Unit of length.")
    georeference: FrameGeoreference | None = Field(
        description="null for given poses in their own world."
    )
    cameras: FrameCameras = Field(description="The cameras of all views.")
    gaussians: FrameGaussians = Field(description="The exported Gaussians.")
    colour: str = Field(description="Colour space of the Gaussians.")
    render: RenderSettings = Field(description="How to render the Gaussians.")


def describe_frame(
    gaussians: GaussianSource,
    views: Sequence[View],
    up: NDArray[np.float64],
    render: RenderSettings,
    files: Sequence[str],
    georeference: Georeference | None = None,
    given_world: Sequence[str] = (),
    num_invented: int = 0,
) -> Frame:
    """The content of ``frame.json``.

    Args:
        views: All views of the scene.
        up: The up direction (3,) in the world.
        files: The names of the exported files.
        georeference: None for given poses in their own world.
        given_world: The files whose coordinates are those of the given poses' world.
        num_invented: The number of invented Gaussians, the last ones of ``gaussians``.
    """
    centres = np.stack([view.centre for view in views])
    x, y, z = (_rounded(value) for value in centres.mean(0))
    world = georeference
    return Frame(
        axes=f"{AXES}; {world.axes}" if world else AXES,
        axes_of={name: text for name in files if (text := _axes_of(name, given_world))},
        up=np.round(up, 6).tolist(),
        unit=world.unit if world else GIVEN_UNIT,
        georeference=world
        and FrameGeoreference(
            method=world.method, origin=world.origin, projection=world.projection
        ),
        cameras=FrameCameras(
            count=len(views), centre=(x, y, z), extent=_rounded(scene_extent(list(views)))
        ),
        gaussians=FrameGaussians(
            count=len(gaussians), sh_degree=gaussians.sh_degree, num_invented=num_invented
        ),
        colour="sRGB: 0.5 + spherical harmonics, blended without conversion to linear",
        render=render,
    )


def _axes_of(name: str, given_world: Sequence[str]) -> str:
    """How a file's coordinates differ from those of the Gaussians; empty if they do not."""
    moved = "the world of the given poses: `georeference.origin` is added"
    parts = [moved] if name in given_world else []
    return "; ".join([*parts, *([OTHER_AXES[name]] if name in OTHER_AXES else [])])


def _rounded(value: float) -> float:
    """Seven significant digits."""
    return float(f"{value:.7g}")
