"""Every option of the product, one section a stage.

Options that only an ablation needs are in ``pipeline.config.experiments``. The reference pages and
``config/config.yaml`` are generated from both. An option whose value is "auto" is settled by the
plan. Importing this module costs pydantic and nothing heavier: the Snakefile imports it.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from pipeline.config.density import Density, Gradient
from pipeline.config.experiments import Experiments
from pipeline.config.holes import Holes
from pipeline.config.section import (
    MAX_PHOTOS,
    Count,
    FilePath,
    LossWeight,
    Minutes,
    Pixels,
    Points,
    Section,
    Seed,
    Share,
    Steps,
    Unit,
)
from pipeline.config.video import VideoExport

#: The largest number of blocks. Each is a job that depends on all others, and Snakemake's time to
#: plan them grows with the square of their number.
MAX_BLOCKS = 200

Device = Literal["auto", "cpu", "gpu"] | Annotated[str, Field(pattern=r"^gpu:[0-9]{1,3}$")]
SHDegree = Annotated[int, Field(ge=0, le=3), Unit("degree")]


class Inspect(Section):
    """The scan of the scene folder."""

    image_folder: FilePath = Field(
        "auto",
        description="Folder of the photographs, relative to the scene folder. auto: images/, else "
        "the scene folder itself or its only subfolder with photographs. Of images/ and "
        "images_2|4|8/, auto takes the smallest that is not below views.max_long_side_px (nor, if "
        "poses are estimated, below features.max_long_side_px).",
    )
    min_images: Count = Field(2, description="Fewer readable photographs are an error.")


class Views(Section):
    """The images that training and evaluation use: resolution and masks."""

    max_long_side_px: Pixels = Field(
        800, description="Longer sides are reduced to this length (by area averaging)."
    )
    masks: Literal["use", "ignore"] = Field(
        "use",
        description="use: pixels that a mask excludes are ignored, if the scene has masks.",
    )


def _not_all(every: int) -> int:
    if every == 1:
        raise ValueError("Input should be 0 or at least 2: 1 leaves no view to train on")
    return every


class Split(Section):
    """Test views: excluded from training, used for evaluation."""

    source: Literal["auto", "every", "published"] = Field(
        "auto",
        description="auto: the split that the given poses list (transforms_train.json and "
        "transforms_test.json, or nerfstudio's train_filenames and test_filenames), else every "
        "n-th view. every: every n-th view of all photographs. published: as papers measure the "
        "scene, which its folder's name and photographs identify: their test views, image size, "
        "masks and background (instead of the options for these), with the given poses unchanged.",
    )
    test_every: Annotated[
        int, Field(ge=0, le=MAX_PHOTOS), AfterValidator(_not_all), Unit("views")
    ] = Field(
        8,
        description="Every n-th view, sorted by name, is a test view (3DGS: 8). 0: no test views; "
        "evaluation uses the training views, and the protocol in metrics.json says so.",
    )
    train_views: Annotated[int, Field(ge=2, le=MAX_PHOTOS), Unit("views")] | None = Field(
        None,
        description="Trains on this number of views, evenly spaced among those that are no test "
        "views, as papers on few views do; with source: published on those that the papers list. "
        "Other photographs are not used, nor are given sparse points. Poses must be given. null: "
        "all views that are no test views.",
    )


class Decode(Section):
    """Development of RAW and EXR photographs; all photographs of a scene with the same settings."""

    demosaic: Literal["linear", "ahd", "aahd"] = Field(
        "ahd", description="Demosaicing algorithm of LibRaw."
    )
    half_size: bool = Field(
        False, description="Half the width and height, about four times as fast."
    )
    linear: bool = Field(
        False, description="16-bit linear values instead of display-ready 8-bit sRGB."
    )
    white_balance: Literal["camera", "daylight"] = Field(
        "camera",
        description="camera: the median of the as-shot white balances, for all photographs; "
        "daylight: the sensor's daylight balance.",
    )


class Video(Section):
    """The frames of videos that are used as photographs."""

    max_frames: Annotated[int, Field(ge=2, le=100_000), Unit("frames")] = Field(
        150,
        description="Maximum number of frames of all videos together. One frame is chosen for "
        "each twentieth of the long side that the image moves, for less motion in slow videos, for "
        "more in long ones.",
    )


#: Number of features of each photograph where those of ``Features.max_features`` connect many
#: photographs weakly, and the largest scene that gets them.
MORE_FEATURES, MAX_PHOTOS_WITH_MORE_FEATURES = 8192, 500


class Features(Section):
    """SIFT features."""

    backend: Literal["opencv", "colmap"] = Field(
        "opencv", description="opencv: OpenCV's SIFT (faster); colmap: COLMAP's extractor."
    )
    max_features: Annotated[int, Field(gt=0, le=1_000_000), Unit("per image")] = Field(
        4096,
        description="Maximum number of features; the strongest are kept. Where these connect many "
        f"photographs weakly, up to {MORE_FEATURES} are extracted and matched instead.",
    )
    max_long_side_px: Pixels = Field(
        1600, description="Larger photographs are reduced to this length before extraction."
    )
    photos_per_job: (
        Literal["auto"] | Annotated[int, Field(gt=0, le=MAX_PHOTOS), Unit("photographs")]
    ) = Field(
        "auto",
        description="Maximum number of photographs of a job of feature extraction; pairs are "
        "matched in as many jobs. auto: one job for up to 500 photographs, else one for every 250. "
        "Changes no result.",
        json_schema_extra={"decides_result": False},
    )


class Matches(Section):
    """Image pairs and their geometric verification."""

    pairs: Literal["auto", "exhaustive", "sequential", "spatial", "retrieval"] = Field(
        "auto",
        description="auto: exhaustive for up to 40 photographs. For more: spatial if GPS positions "
        "separate them, sequential if times or file names give an order, else retrieval.",
    )
    neighbours: Annotated[int, Field(gt=0, le=10_000), Unit("per image")] = Field(
        16, description="Pairs per image of sequential, spatial and retrieval matching."
    )


class Sfm(Section):
    """Structure from motion: camera poses and sparse points."""

    mapper: Literal["auto", "incremental", "global"] = Field(
        "auto", description="auto: incremental; global if the incremental model is not good."
    )
    camera_model: Literal[
        "auto",
        "SIMPLE_PINHOLE",
        "PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "OPENCV",
        "OPENCV_FISHEYE",
        "EQUIRECTANGULAR",
    ] = Field(
        "auto",
        description="COLMAP's camera model. auto: SIMPLE_RADIAL; OPENCV_FISHEYE if EXIF names a "
        "fisheye lens; EQUIRECTANGULAR for panoramas (GPano metadata, or a 360 degree camera in "
        "EXIF). EQUIRECTANGULAR: all photographs are panoramas. Others: of the photographs that "
        "are not panoramas.",
    )
    share_cameras: Literal["auto", "single", "group", "folder", "image"] = Field(
        "auto",
        description="Which images share intrinsics. single: all; group: those of one body, lens, "
        "focal length and size; folder: those of a group in the same folder; image: none; auto: "
        "group, folder if the photographs are in several folders, or image for collections from "
        "many cameras.",
    )
    refine_principal_point: Literal["if_determined", "yes", "no"] = Field(
        "if_determined",
        description="if_determined: refined in the last bundle adjustment and kept if the geometry "
        "determines it; for given poses, only if it is exactly in the image centre.",
    )
    min_registered_share: Share = Field(
        0.5, description="A model with a smaller share of registered photographs is an error."
    )
    component: Annotated[int, Field(ge=0, le=MAX_PHOTOS), Unit("number")] = Field(
        0,
        description="Which part of the scene is used if the photographs fall into several that "
        "cannot be joined: 0 is the largest. sfm/stage.json lists them.",
    )
    georeference: Literal["auto", "gps", "gcp", "none"] = Field(
        "auto",
        description="Coordinate frame of the model. gcp: metres in the projection of gcp_list.txt "
        "(OpenDroneMap's ground control points); gps: metres east, north and up from the EXIF "
        "positions; none: levelled, y down, unit size; auto: the first of these that is available. "
        "Origin and residuals are written to sfm/georeference.json.",
    )


class Undistort(Section):
    """Undistortion of images and masks to pinhole cameras."""

    blank_pixels: Share = Field(
        0.0, description="Allowed share of blank border. 0: crop to valid pixels; 1: keep all."
    )
    jpeg_quality: Annotated[int, Field(ge=0, le=100), Unit("percent")] = Field(
        0, description="JPEG quality of the undistorted images. 0: lossless PNG."
    )
    mask_nadir_degrees: Annotated[float, Field(ge=0, le=90), Unit("degrees")] = Field(
        0.0,
        description="Panoramas: pixels closer than this to straight down (tripod, photographer) "
        "are ignored in training.",
    )


class Init(Section):
    """The initial Gaussians."""

    method: Literal["auto", "points", "random", "dense"] = Field(
        "auto",
        description="points: from the sparse points, which are triangulated if the given poses "
        "have none, or from a point cloud of the scene; dense: from depth maps that multi-view "
        "stereo estimates; auto: dense for up to 30 photographs without alpha, masks, depth maps "
        "or a point cloud, else points.",
    )
    max_points: Points = Field(
        200_000,
        description="More sparse points are thinned to this number, or to half of "
        "train.density.max_gaussians, to leave room for densification.",
    )
    points_file: FilePath = Field(
        "auto",
        description="Point cloud that the Gaussians are initialised from, relative to the scene "
        "folder: a file (.ply, .las, .laz, .e57, .xyz, .csv, .pts) or a folder of them, in the "
        "frame and unit of the given poses. auto: points.* or points/, else the ply_file_path of "
        "transforms.json; none: the sparse points.",
    )


class Train(Section):
    """The optimisation of the Gaussians."""

    steps: Steps = Field(
        4000,
        description="Optimiser steps, one view each. Below 7000, intervals that are counted in "
        "steps shrink in proportion.",
    )
    budget_minutes: Minutes | None = Field(
        None,
        description="Train for this time instead of a number of steps. The number of steps depends "
        "on the machine and its load, so that results of two runs differ.",
    )
    device: Device = Field(
        "auto",
        description="What trains: cpu, the processor; gpu, a GPU through WebGPU, or another than "
        "the first (gpu:1); it needs `pip install 'splatmake[gpu]'` (in a checkout: '.[gpu]'). "
        "auto: a GPU if a short measurement on this machine finds that it is faster, but not on a "
        "cluster.",
    )
    sh_degree: SHDegree = Field(3, description="Maximum degree of the spherical harmonics.")
    background: Literal["auto", "measured", "skybox", "fill", "black", "white", "random"] = Field(
        "auto",
        description="What is behind the scene. skybox: Gaussians on a distant sphere, which become "
        "the sky and fill what no photograph shows; fill: the same in the colours of the nearest "
        "points, which training leaves as they are; random: another colour in each step; measured: "
        "skybox if the photographs show sky, black or white if that is the backdrop's colour, "
        "black if masks leave an object that stands alone, else fill; auto: white if most images "
        "have alpha, black if some have or with strategy: original, else measured.",
    )
    appearance: Literal["measured", "none", "exposure", "embedding"] = Field(
        "measured",
        description="How colours differ between photographs. none: they do not; exposure: renders "
        "are multiplied by each photograph's exposure and white balance, measured at the sparse "
        "points; embedding: the colours of Gaussians depend on a vector for each photograph, for "
        "another light or weather, and test views are measured on the right half after a fit on "
        "the left. measured: embedding if photographs disagree on colours after exposure, else "
        "exposure if exposures differ. measured, exposure: also vignetting and brightness ramps.",
    )
    transients: Literal["auto", "find", "none"] = Field(
        "auto",
        description="What only one or few photographs show, such as people who pass by. find: "
        "where the other photographs contradict a photograph, its pixels are left out of the loss, "
        "in runs of at least 30 epochs on at least 8 views without alpha. auto: find, but none for "
        "photographs with masks, in blocks, and with strategy: original. none: all are used.",
    )
    refine_poses: bool = Field(
        False,
        description="Refine the poses during training, for given poses that are inaccurate. Test "
        "views are aligned to their photographs before evaluation, and the protocol says so.",
    )
    refine_intrinsics: bool = Field(
        False,
        description="Refine focal lengths and principal points during training, for given "
        "intrinsics that are inaccurate. Views of one camera share them.",
    )
    antialias: bool = Field(
        False,
        description="Mip-Splatting's opacity compensation for Gaussians smaller than a pixel. Only "
        "viewers that compensate as well show the scene as trained.",
    )
    ssim_loss_weight: Annotated[float, Field(ge=0, le=1), Unit("share")] = Field(
        0.3, description="Share of D-SSIM in the colour loss (3DGS: 0.2); the rest is pixel errors."
    )
    depth_loss_weight: Literal["auto"] | LossWeight = Field(
        "auto",
        description="Weight of the error of the logarithm of the depth, at sparse points and in "
        "depth maps of depths/, or in those of multi-view stereo with init.method: dense. 0: no "
        "depth loss; auto: 0.3 with depth maps, else 0.03 for up to 30 photographs, else 0.",
    )
    density: Density = Field(default_factory=Gradient)


class Partition(Section):
    """Division of large scenes into blocks that are trained in jobs of their own."""

    blocks: Literal["auto"] | Annotated[int, Field(gt=0, le=MAX_BLOCKS), Unit("count")] = Field(
        "auto",
        description="Number of blocks, at most one for every two photographs. auto: 1 for up to "
        "1000 photographs, else one for every 250; more where `memory_mb` requires it.",
    )
    memory_mb: Annotated[int, Field(gt=0, le=100_000_000), Unit("MB")] | None = Field(
        None,
        description="Memory that a job may use. A scene whose training would need more is divided "
        "into blocks, or, with `blocks: 1`, gets fewer Gaussians. Training images that do not fit "
        "are read from disk, and jobs that process several photographs at a time run fewer "
        "threads, which changes no result. null: no limit, but images are read from disk if "
        "training would take over three quarters of the memory of the machine or container.",
        json_schema_extra={"decides_result": False},
    )


class Evaluate(Section):
    """Test views compared with renders."""

    lpips_net: Literal["vgg", "alex", "none"] = Field(
        "vgg", description="Network of LPIPS, measured if `splatmake fetch lpips` has fetched it."
    )


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
    "points",
    "colmap",
    "colmap_text",
    "transforms",
    "dense_points",
    "dense_maps",
    "masks",
    "renders",
    "depths",
    "mesh",
    "video",
]
ExportFormats = Annotated[tuple[ExportFormat, ...], Field(max_length=1000), AfterValidator(_once)]
# The formats that need multi-view stereo.
DENSE_FORMATS: frozenset[ExportFormat] = frozenset(("dense_points", "dense_maps"))
# The format that needs the blocks of the scene.
BLOCKS_FORMAT: ExportFormat = "blocks"
# The format that needs the photographs before undistortion.
MASKS_FORMAT: ExportFormat = "masks"
# The formats that need renders of the views.
RENDERED_FORMATS: frozenset[ExportFormat] = frozenset(("renders", "depths", "mesh", "video"))


class Export(Section):
    """Files for other programs."""

    formats: ExportFormats = Field(
        ("ply", "spz", "points", "colmap", "transforms"),
        description="Gaussians: ply (3DGS's layout, exact), blocks (a PLY file for each block of a "
        "scene), spz (version 3, a sixth of the size), spz4 (version 4, which fewer programs "
        "read, for up to 30 million Gaussians instead of 10), sog (PlayCanvas's format, about a "
        "seventh of the size), sog_lod (Streamed SOG: a folder of chunks at five levels of detail, "
        "for large scenes on the web), splat (without SH), gltf (.glb with "
        "KHR_gaussian_splatting). "
        "points: coloured sparse points. "
        "Cameras: colmap (with the points), colmap_text (the same as text), transforms "
        "(nerfstudio's transforms.json). Multi-view stereo of the training views: dense_points "
        "(fused point cloud, PLY with normals), dense_maps (depths, float TIFF). masks: what "
        "train.transients left out, as masks of the photographs (PNG). Rendered from every view: "
        "renders (PNG), depths (float TIFF), mesh (PLY and GLB), video (along a camera path).",
    )
    sh_degree: SHDegree = Field(3, description="Maximum degree of the exported SH.")
    mesh_voxel: Annotated[float, Field(ge=1e-9, le=1e9), Unit("scene units")] | None = Field(
        None,
        description="Voxel size of the mesh. null: 2.5 pixels at the median depth; larger if that "
        "would take over 24 million voxels.",
    )
    video: VideoExport = Field(default_factory=VideoExport)


class Config(Section):
    """All options of a scene."""

    preset: Literal["fast", "balanced", "high", "original"] = Field(
        "balanced", description="Set of default values; other options take precedence."
    )
    poses: Literal["auto", "keep", "trust", "ignore"] = Field(
        "auto",
        description="Poses in the scene folder. auto: used, and refined by bundle adjustment of "
        "their own tracks if the principal points are only assumed; keep: used without changes; "
        "trust: as keep, and not compared with the photographs; ignore: not used, poses are "
        "estimated.",
    )
    seed: Seed = Field(0, description="Seed of all random numbers.")
    inspect: Inspect = Field(default_factory=Inspect)
    views: Views = Field(default_factory=Views)
    split: Split = Field(default_factory=Split)
    decode: Decode = Field(default_factory=Decode)
    video: Video = Field(default_factory=Video)
    features: Features = Field(default_factory=Features)
    matches: Matches = Field(default_factory=Matches)
    sfm: Sfm = Field(default_factory=Sfm)
    undistort: Undistort = Field(default_factory=Undistort)
    init: Init = Field(default_factory=Init)
    train: Train = Field(default_factory=Train)
    partition: Partition = Field(default_factory=Partition)
    holes: Holes = Field(default_factory=Holes)
    evaluate: Evaluate = Field(default_factory=Evaluate)
    export: Export = Field(default_factory=Export)
    experiments: Experiments = Field(default_factory=Experiments)
