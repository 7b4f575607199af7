"""Synthetic captures without images: a database of keypoints and matches of surface points.

Keypoints are projected surface points with noise. The probability of a match follows SIFT: none for
back faces, grazing angles and large scale changes; otherwise it falls with the angle between the
views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.demo.cameras import look_at
from pipeline.geometry.cameras import Camera
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import PosedImage, Reconstruction

Array = NDArray[np.float64]
Triple = Array | tuple[float, float, float]
Ints = NDArray[np.int64]

WIDTH, HEIGHT = 640, 480
FOCAL, RADIAL = 560.0, -0.06
NOISE_PX = 0.5
# The shares of the points in view that are detected, and of those in two images that are matched.
DETECTED, MATCHED = 0.75, 0.85
# The angle between two views at which half of the matches of SIFT are lost.
HALF_ANGLE_DEG = 30.0
MAX_GRAZING_DEG = 72.0
MAX_SCALE_RATIO = 2.5
# The wrong matches of a pair that pass the ratio test: a share of the correct ones, plus a number.
WRONG_SHARE, WRONG_MATCHES = 0.08, 4
MIN_INLIERS = 15


@dataclass(frozen=True)
class Surface:
    """Points of a surface with their appearance.

    Attributes:
        xyz, normal: The positions and the normals, (P, 3).
        look: The appearance, (P,): points with equal numbers look the same.
    """

    xyz: Array
    normal: Array
    look: Ints

    def __add__(self, other: Surface) -> Surface:
        first = int(self.look.max()) + 1 if len(self.look) else 0
        return Surface(
            np.concatenate([self.xyz, other.xyz]),
            np.concatenate([self.normal, other.normal]),
            np.concatenate([self.look, other.look + first]),
        )


@dataclass(frozen=True)
class Shot:
    """One photograph.

    Attributes:
        rotation, centre: The true pose, world to camera.
        scene: The index of the visible scene.
        mirrored: Whether the photograph is flipped horizontally.
        prior: The focal length in EXIF over the true one; None without EXIF.
        blur: The additional noise of the keypoints, pixels.
        copy_of: The index of the photograph that this is a copy of.
        camera: The number of the camera; photographs with equal numbers share one.
    """

    rotation: Array
    centre: Array
    scene: int = 0
    mirrored: bool = False
    prior: float | None = None
    blur: float = 0.0
    copy_of: int | None = None
    camera: int = 0


@dataclass(frozen=True)
class Made:
    """A synthetic capture: scenes and photographs."""

    scenes: Sequence[Surface]
    shots: Sequence[Shot]
    radial: float = RADIAL
    solid: Sequence[tuple[Triple, float]] = field(default_factory=tuple)
    """Spheres (centre, radius) that occlude what is behind them."""


def plane(
    rng: np.random.Generator, origin: Triple, u: Triple, v: Triple, count: int, relief: float = 0.0
) -> Surface:
    """Points on a parallelogram with normal u x v, raised along it by up to ``relief``."""
    first, second, corner = (np.asarray(a, np.float64) for a in (u, v, origin))
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal)
    s, t, h = rng.uniform(0, 1, (3, count, 1))
    xyz = corner + s * first + t * second + h * relief * normal
    tilted = normal + rng.normal(0, 0.15, (count, 3))
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    return Surface(xyz, tilted, np.arange(count))


def ball(rng: np.random.Generator, centre: Triple, radius: float, count: int) -> Surface:
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Surface(np.asarray(centre) + radius * normal, normal, np.arange(count))


def room(rng: np.random.Generator, side: float, count: int) -> Surface:
    """The floor (z = 0) and four walls, seen from inside."""
    h, tall = side / 2, 0.5 * side
    each = count // 5
    walls = plane(rng, (-h, -h, 0), (side, 0, 0), (0, side, 0), each)
    for corner, along in (
        ((-h, h, 0), (side, 0, 0)),
        ((h, -h, 0), (-side, 0, 0)),
        ((-h, -h, 0), (0, side, 0)),
        ((h, h, 0), (0, -side, 0)),
    ):
        walls = walls + plane(rng, corner, along, (0, 0, tall), each)
    return walls


def looking(centre: Triple, target: Triple, roll: float = 0.0, **facts: Any) -> Shot:
    at = np.asarray(centre, np.float64)
    return Shot(look_at(at, np.asarray(target, np.float64), roll), at, **facts)


@dataclass(frozen=True)
class Written:
    """Photographs and ground truth of a synthetic capture.

    Attributes:
        truths: The cameras of each scene and of each mirrored scene. A model can contain only
            one of them.
        depth: The median distance of the visible points.
    """

    manifest: Manifest
    truths: tuple[Reconstruction, ...]
    depth: float


def write(made: Made, path: Path, seed: int) -> Written:
    """Write the database of matches and verified pairs."""
    rng = np.random.default_rng([seed, 77])
    seen = [_see(made, shot, rng) for shot in made.shots]
    for index, shot in enumerate(made.shots):
        if shot.copy_of is not None:
            seen[index] = seen[shot.copy_of]
    names = [f"{index:03d}.jpg" for index in range(len(made.shots))]
    path.unlink(missing_ok=True)
    camera_ids: dict[tuple[int, float | None], int] = {}
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for index, (shot, view) in enumerate(zip(made.shots, seen, strict=True), start=1):
            key = (shot.camera, shot.prior)
            if key not in camera_ids:
                camera_ids[key] = len(camera_ids) + 1
                _write_camera(database, camera_ids[key], shot.prior)
            _write_image(database, index, names[index - 1], camera_ids[key], view.xy)
        for i in range(len(seen)):
            for j in range(i + 1, len(seen)):
                matches = _match(made, i, j, seen, rng)
                # A pair with fewer matches cannot be verified, and trying takes longest.
                if len(matches) >= MIN_INLIERS:
                    database.write_matches(i + 1, j + 1, matches.astype(np.uint32))
    options = pycolmap.TwoViewGeometryOptions(min_num_inliers=MIN_INLIERS)
    options.ransac.random_seed = seed
    verifier = pycolmap.GeometricVerifierOptions(num_threads=1)
    pycolmap.geometric_verification(path, verifier, two_view_geometry_options=options)
    photos = tuple(
        Photo(name=name, path=name, width=WIDTH, height=HEIGHT, digest="") for name in names
    )
    truths = {(shot.scene, shot.mirrored): _truth(made, names, shot) for shot in made.shots}
    depth = float(np.median(np.concatenate([view.depth for view in seen])))
    return Written(Manifest(scene="made", photos=photos), tuple(truths.values()), depth)


def _truth(made: Made, names: Sequence[str], like: Shot) -> Reconstruction:
    """The cameras of the scene that ``like`` shows. A flipped photograph is that of a camera and a
    world both mirrored in x."""
    params = np.array([FOCAL, WIDTH / 2, HEIGHT / 2, made.radial])
    mirror = np.diag([-1.0, 1.0, 1.0]) if like.mirrored else np.eye(3)
    images = {}
    for i, shot in enumerate(made.shots, start=1):
        if (shot.scene, shot.mirrored) == (like.scene, like.mirrored):
            rotation = mirror @ shot.rotation @ mirror
            images[i] = PosedImage(names[i - 1], 1, rotation, -rotation @ mirror @ shot.centre)
    return Reconstruction({1: Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, params)}, images)


@dataclass(frozen=True)
class _Seen:
    """The keypoints of a photograph: (F, 2) xy, and the point of each, sorted by point."""

    xy: Array
    point: Ints
    look: Ints
    ray: Array
    depth: Array


def _see(made: Made, shot: Shot, rng: np.random.Generator) -> _Seen:
    surface = made.scenes[shot.scene]
    local = (surface.xyz - shot.centre) @ shot.rotation.T
    ahead = local[:, 2] > 0.1
    flat = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]
    r2 = (flat**2).sum(1, keepdims=True)
    # Outside its monotonic range, the distortion would map rays back into the image.
    ahead &= (r2 < 1.0)[:, 0]
    xy = FOCAL * flat * (1 + made.radial * r2) + (WIDTH / 2, HEIGHT / 2)
    to_camera = shot.centre - surface.xyz
    depth = np.linalg.norm(to_camera, axis=1)
    ray = to_camera / depth[:, None]
    facing = (ray * surface.normal).sum(1) > np.cos(np.radians(MAX_GRAZING_DEG))
    inside = ((xy > 2) & (xy < (WIDTH - 2, HEIGHT - 2))).all(1)
    kept = ahead & facing & inside & (rng.uniform(size=len(xy)) < DETECTED)
    for centre, radius in made.solid:
        kept &= ~_hidden(surface.xyz, shot.centre, np.asarray(centre), radius)
    index = np.flatnonzero(kept)
    found = xy[index] + rng.normal(0, np.hypot(NOISE_PX, shot.blur), (len(index), 2))
    if shot.mirrored:
        found[:, 0] = WIDTH - found[:, 0]
    return _Seen(found, index, surface.look[index], ray[index], depth[index])


def _hidden(points: Array, camera: Array, centre: Array, radius: float) -> NDArray[np.bool_]:
    """Whether a sphere occludes each point; points of the sphere itself are not occluded."""
    way = points - camera
    along = np.clip(((centre - camera) * way).sum(1) / (way**2).sum(1), 0, 1)
    nearest = camera + along[:, None] * way
    return np.asarray(np.linalg.norm(nearest - centre, axis=1) < 0.97 * radius)


def _match(made: Made, i: int, j: int, seen: list[_Seen], rng: np.random.Generator) -> Ints:
    a, b = seen[i], seen[j]
    first, second = made.shots[i], made.shots[j]
    if len(a.xy) == 0 or len(b.xy) == 0:
        return np.zeros((0, 2), np.int64)
    right = np.zeros((0, 2), np.int64)
    if first.scene == second.scene and first.mirrored == second.mirrored:
        # The ratio test rejects points with several equal counterparts.
        ua, ca = np.unique(a.look, return_counts=True)
        ub, cb = np.unique(b.look, return_counts=True)
        alone = np.intersect1d(ua[ca == 1], ub[cb == 1])
        row = np.flatnonzero(np.isin(a.look, alone))
        row = row[np.argsort(a.look[row])]
        column = np.flatnonzero(np.isin(b.look, alone))
        column = column[np.argsort(b.look[column])]
        if first.copy_of is not None or second.copy_of is not None:
            same = (first.copy_of if first.copy_of is not None else i) == (
                second.copy_of if second.copy_of is not None else j
            )
        else:
            same = False
        likely = np.full(len(row), MATCHED)
        if not same and len(row):
            normal = made.scenes[first.scene].normal
            # Points of equal appearance are compared by their viewing angles.
            angle = _presented_angle(
                a.ray[row], normal[a.point[row]], b.ray[column], normal[b.point[column]]
            )
            ratio = np.maximum(a.depth[row] / b.depth[column], b.depth[column] / a.depth[row])
            likely *= np.exp(-np.log(2) * (angle / HALF_ANGLE_DEG) ** 2)
            likely[ratio > MAX_SCALE_RATIO] = 0.0
        kept = rng.uniform(size=len(row)) < likely
        right = np.column_stack([row[kept], column[kept]])
    wrong = rng.poisson(WRONG_MATCHES + WRONG_SHARE * len(right))
    noise = np.column_stack([rng.integers(0, len(a.xy), wrong), rng.integers(0, len(b.xy), wrong)])
    both = np.concatenate([right, noise])
    # A keypoint is matched once; correct matches come first.
    _, keep = np.unique(both[:, 0], return_index=True)
    both = both[np.sort(keep)]
    _, keep = np.unique(both[:, 1], return_index=True)
    return np.asarray(both[np.sort(keep)])


def _presented_angle(ray_a: Array, normal_a: Array, ray_b: Array, normal_b: Array) -> Array:
    """The angle in degrees between two observations: for one point, between its rays; for two
    points of equal appearance, the difference of their viewing angles."""
    same = (np.abs(normal_a - normal_b) < 1e-9).all(1)
    rays = np.degrees(np.arccos(np.clip((ray_a * ray_b).sum(1), -1, 1)))
    slant_a, slant_b = (
        np.degrees(np.arccos(np.clip((r * n).sum(1), -1, 1)))
        for r, n in ((ray_a, normal_a), (ray_b, normal_b))
    )
    return np.asarray(np.where(same, rays, np.abs(slant_a - slant_b)))


def _write_camera(database: pycolmap.Database, camera_id: int, prior: float | None) -> None:
    focal = 1.2 * max(WIDTH, HEIGHT) if prior is None else prior * FOCAL
    camera = pycolmap.Camera.create_from_model_name(
        camera_id, "SIMPLE_RADIAL", focal, WIDTH, HEIGHT
    )
    camera.has_prior_focal_length = prior is not None
    database.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    database.write_rig(rig, use_rig_id=True)


def _write_image(
    database: pycolmap.Database, image_id: int, name: str, camera_id: int, xy: Array
) -> None:
    image = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id)
    database.write_image(image, use_image_id=True)
    frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
    frame.add_data_id(image.data_id)
    database.write_frame(frame, use_frame_id=True)
    table = np.column_stack([xy, np.ones(len(xy)), np.zeros(len(xy))]).astype(np.float32)
    database.write_keypoints(image_id, table.reshape(-1, 4))
