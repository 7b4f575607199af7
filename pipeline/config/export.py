"""Options of exported files."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from pipeline.config.section import Box, GaussianCount, Section, SHDegree, Unit
from pipeline.config.video import VideoExport


def _once(formats: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(formats))


ExportFormat = Literal[
    "ply",
    "blocks",
    "spz",
    "spz4",
    "sog",
    "sog_lod",
    "splat",
    "gltf",
    "usd",
    "tiles3d",
    "points",
    "colmap",
    "colmap_text",
    "transforms",
    "dense_points",
    "dense_maps",
    "ortho",
    "laz",
    "masks",
    "renders",
    "depths",
    "mesh",
    "video",
]
ExportFormats = Annotated[tuple[ExportFormat, ...], Field(max_length=1000), AfterValidator(_once)]
# The formats that need multi-view stereo; the mesh of a region is of its Gaussians alone.
DENSE_FORMATS: frozenset[ExportFormat] = frozenset(
    ("dense_points", "dense_maps", "ortho", "laz", "mesh")
)
# The formats that are maps, which have a page on their accuracy beside them.
SURVEY_FORMATS: frozenset[ExportFormat] = frozenset(("ortho", "laz"))
# The format that needs the blocks of the scene.
BLOCKS_FORMAT: ExportFormat = "blocks"
# The format that needs the photographs before undistortion.
MASKS_FORMAT: ExportFormat = "masks"
# The files of Gaussians that do not hold every bit of them; their loss is measured.
LOSSY_FORMATS: tuple[ExportFormat, ...] = ("spz", "spz4", "sog", "splat")
# The loss of larger scenes is not measured: its renders hold all Gaussians several times.
MAX_MEASURED_LOSSES = 2_000_000
# The formats that need a scene that GPS or ground control points place on the earth.
PLACED_FORMATS: frozenset[ExportFormat] = frozenset(("tiles3d", "ortho", "laz"))
# The largest width and height of a mesh's texture by default: WebGL 2 has at least half of it on
# any device, and most phones have it.
MAX_TEXTURE_PX = 4096
# The formats that need renders of the views.
RENDERED_FORMATS: frozenset[ExportFormat] = frozenset(("renders", "depths", "mesh", "video"))


class Export(Section):
    """Files for other programs."""

    formats: ExportFormats = Field(
        ("ply", "spz", "points", "colmap", "transforms"),
        description="Gaussians: ply (3DGS's layout, exact), blocks (a PLY file for each block of a "
        "scene), spz (version 3, a sixth of the size), spz4 (version 4, which fewer programs "
        "read, for up to 30 million Gaussians instead of 10), sog (PlayCanvas's format, about a "
        "seventh of the size), sog_lod (Streamed SOG: a folder of files at five or more levels of "
        "detail, for large scenes on the web), splat (without SH), gltf (.glb with "
        "KHR_gaussian_splatting), usd (.usdc, OpenUSD's ParticleField3DGaussianSplat; needs the "
        "extra `usd`), tiles3d (3D Tiles 1.1 at the scene's place on the earth, for CesiumJS: a "
        "folder of tiles at several levels of detail; needs GPS or ground control points). "
        "points: coloured sparse points. "
        "Cameras: colmap (with the points), colmap_text (the same as text), transforms "
        "(nerfstudio's transforms.json). Multi-view stereo of the training views: dense_points "
        "(fused point cloud, PLY with normals), dense_maps (depths, float TIFF). Of scenes with "
        "GPS or ground control points: ortho (orthophoto and surface model, GeoTIFF), laz (fused "
        "point cloud, LAZ), both with accuracy.html. masks: what "
        "train.transients left out, as masks of the photographs (PNG). Rendered from every view: "
        "renders (PNG), depths (float TIFF), video (along a camera path). From both: mesh (GLB "
        "with a texture from the photographs, and PLY with colours).",
    )
    sh_degree: SHDegree = Field(3, description="Maximum degree of the exported SH.")
    max_gaussians: GaussianCount | None = Field(
        None,
        description="The largest number of exported Gaussians. Pairs are merged where the training "
        "views show least of them, by the sum of alpha times transmittance, and all are refined "
        "so that the views look as with all of them. null: no limit.",
    )
    region: Literal["subject"] | Box | None = Field(
        None,
        description="Export only what lies in a box, [x0, y0, z0, x1, y1, z1] in the frame and "
        "unit of the exported Gaussians, without the skybox. subject: a box around what most "
        "cameras have in their images. null: everything.",
    )
    ground_sampling_m: Annotated[float, Field(ge=1e-3, le=100.0), Unit("m")] | None = Field(
        None,
        description="Size of a cell of the orthophoto. null: the median size of a pixel of the "
        "training views on the ground, two significant digits.",
    )
    mesh_voxel: Annotated[float, Field(ge=1e-9, le=1e9), Unit("scene units")] | None = Field(
        None,
        description="Voxel size of the mesh. null: 2.5 pixels at the median depth; larger if that "
        "would take over 24 million voxels.",
    )
    mesh_faces: Annotated[int, Field(ge=4, le=50_000_000), Unit("triangles")] | None = Field(
        None,
        description="Triangles of the mesh, fewer by quadric error metrics. null: an eighth of "
        "those of marching cubes.",
    )
    texture_px: Annotated[int, Field(ge=64, le=8192), Unit("pixels")] | None = Field(
        None,
        description="Largest width and height of the mesh's texture, whose size follows from the "
        "pixels of the photographs. null: 4096.",
    )
    video: VideoExport = Field(default_factory=VideoExport)

    @property
    def dense_formats(self) -> list[ExportFormat]:
        """The formats for which multi-view stereo runs."""
        cropped = self.region is not None
        return [
            name
            for name in self.formats
            if name in DENSE_FORMATS and not (cropped and name == "mesh")
        ]
