"""Texture of a mesh from the photographs.

Each texel is a mean over the views that see it. The weight is a power of the pixels per area that a
view has there, so that the best views decide, while others fade in and out without seams (Callieri
et al. 2008). Colours far from the mean of all views, such as passers-by and highlights, weigh less:
the mean is taken twice. A view sees a triangle if nothing of the mesh is in front of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, minimum_filter

from pipeline.config.export import MAX_TEXTURE_PX
from pipeline.photos.load import load_view
from pipeline.runtime.isolate import run_isolated
from pipeline.runtime.progress import track
from pipeline.scene.exposure import NO_GAINS, ExposureGains
from pipeline.scene.views import View
from pipeline.surface.atlas import Atlas, cut_and_pack
from pipeline.surface.mesh import Mesh
from pipeline.surface.triangles import Drawn, barycentric, draw_triangles
from pipeline.surface.tsdf import camera_space

Array = NDArray[np.float64]

#: Exponent of the pixels per area in the weight of a view.
SHARPNESS = 2.0
#: Cosines of the viewing angle below it are not used.
LEAST_COSINE = 0.2
#: Standard deviation of the weight by the distance to the first mean, in display values of 255.
SPREAD = 20.0
#: Views fade out over this share of their shorter side towards the border.
BORDER = 0.05
#: Texels per unit of length on triangles that no view sees, as a share of the median elsewhere.
UNSEEN = 0.1

_TEXELS = 1 << 16


@dataclass(frozen=True)
class TexturedMesh:
    """A mesh with a texture.

    Attributes:
        vertices: (W, 3) float32, world; doubled where charts of the texture end.
        faces: (F, 3) int32, counter-clockwise seen from outside.
        normals: (W, 3) float32.
        uv: (W, 2) float32 texture coordinates, (0, 0) is the upper left corner of the picture.
        picture: (H, W, 3) uint8, sRGB.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32]
    uv: NDArray[np.float32]
    picture: NDArray[np.uint8]


class Photographs:
    """The photographs of the training views, levelled to the typical exposure.

    Args:
        gains: What ``exposure.json`` has.
    """

    def __init__(self, views: Sequence[View], gains: ExposureGains = NO_GAINS):
        self.views = [view for view in views if not view.is_test]
        self._gains = gains

    def __iter__(self) -> Iterator[tuple[View, NDArray[np.float32], NDArray[np.bool_]]]:
        """Each view with its (H, W, 3) colours, display values of 255, and whether (H, W) pixels
        count: masked, transparent and overexposed ones do not."""
        for view in self.views:
            pixels = load_view(view)
            valid = np.ones((view.height, view.width), bool)
            if pixels.mask is not None:
                valid &= pixels.mask
            if pixels.alpha is not None:
                valid &= pixels.alpha == 255
            rgb = pixels.rgb.astype(np.float32)
            light = self._gains.of(view.name)
            if light is not None:
                rgb /= light.factor(view)
            yield view, rgb, valid


def texture_mesh(
    mesh: Mesh,
    photographs: Photographs,
    voxel: float,
    texture_px: int | None,
    threads: int,
) -> TexturedMesh:
    """Cut the mesh into charts and colour their texels; the same bits at any number of threads.

    Args:
        voxel: The accuracy of the mesh, world units.
        texture_px: The largest width and height of the texture; None: ``MAX_TEXTURE_PX``.
    """
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
    sight = _Sight(vertices, faces, voxel)
    density = sight.density(photographs.views)
    usual = float(np.median(density[density > 0])) if density.any() else 1 / voxel
    # Unseen triangles, which have the colour of those beside them, need few texels.
    density = np.maximum(density, UNSEEN * usual)
    # In a process of its own: xatlas crashes on some meshes.
    atlas = run_isolated(cut_and_pack, vertices, faces, density, texture_px or MAX_TEXTURE_PX)
    baker = _Baker(sight, atlas)
    first = baker.mean(track(photographs, "texture", len(photographs.views), unit="views"), threads)
    again = track(photographs, "texture, second mean", len(photographs.views), unit="views")
    second = baker.mean(again, threads, first)
    colours = np.where(second[1][:, None] > 0, second[0], first[0])
    picture = baker.picture(colours, first[1] > 0)
    size = np.array(atlas.size, np.float64)
    return TexturedMesh(
        mesh.vertices[atlas.source],
        atlas.faces.astype(np.int32),
        mesh.normals[atlas.source],
        (atlas.uv / size).astype(np.float32),
        picture,
    )


class _Sight:
    """What views see of a mesh."""

    def __init__(self, vertices: Array, faces: NDArray[np.int64], voxel: float):
        self.vertices, self.faces, self.voxel = vertices, faces, voxel
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        cross = np.cross(b - a, c - a)
        length = np.linalg.norm(cross, axis=1)
        self.area = length / 2
        self.centre = (a + b + c) / 3
        self.normal = cross / np.maximum(length, 1e-300)[:, None]

    def draw(self, view: View) -> Drawn:
        """The mesh in the view."""
        x, y, z = camera_space(view, self.vertices)
        inverse = np.where(z > 1e-9, 1 / np.maximum(z, 1e-9), 0.0)
        xy = np.column_stack([view.fx * x * inverse + view.cx, view.fy * y * inverse + view.cy])
        return draw_triangles(xy, inverse, self.faces, view.width, view.height)

    def candidates(self, view: View, drawn: Drawn) -> NDArray[np.intp]:
        """The triangles of which the view sees a part, and that face it."""
        found = np.zeros(len(self.faces), bool)
        found[drawn.face[drawn.face >= 0]] = True
        nearest = _nearest(drawn)
        for corner in (self.centre, *(self.vertices[self.faces[:, i]] for i in range(3))):
            seen, _ = self.visible(view, nearest, corner, self.normal)
            found |= seen
        return np.flatnonzero(found & (self.facing(view, self.centre, self.normal) > LEAST_COSINE))

    def facing(self, view: View, points: Array, normals: Array) -> Array:
        """(N,) cosine of the angle between the normals and the rays to the view."""
        ray = view.centre - points
        length = np.sqrt((ray * ray).sum(axis=1))
        return np.asarray((ray * normals).sum(axis=1) / np.maximum(length, 1e-300))

    def visible(
        self, view: View, nearest: NDArray[np.float32], points: Array, normals: Array
    ) -> tuple[NDArray[np.bool_], tuple[Array, Array, Array]]:
        """Whether the view sees (N, 3) points on the mesh, and their pixels u, v and depths z.

        Args:
            nearest: ``_nearest`` of the mesh in the view.
        """
        x, y, z = camera_space(view, points)
        front = np.maximum(z, 1e-9)
        u, v = view.fx * x / front + view.cx, view.fy * y / front + view.cy
        seen = (z > 0) & (u >= 0) & (v >= 0) & (u < view.width) & (v < view.height)
        column, row = np.where(seen, u, 0).astype(np.intp), np.where(seen, v, 0).astype(np.intp)
        cosine = np.maximum(self.facing(view, points, normals), LEAST_COSINE)
        # The depth changes by this much from a pixel to the next but one on a slanted surface.
        slope = 3 * front / min(view.fx, view.fy) * np.sqrt(1 - cosine**2) / cosine
        found = nearest[row, column].astype(np.float64)
        seen &= z <= found + slope + self.voxel / 2
        return seen, (u, v, z)

    def density(self, views: Sequence[View]) -> Array:
        """(F,) pixels per unit of length on each triangle in the view that has most there; 0 for
        those that no view sees."""
        best = np.zeros(len(self.faces))
        for view in views:
            drawn = self.draw(view)
            rows = self.candidates(view, drawn)
            _, _, z = camera_space(view, self.centre[rows])
            # The centre of a large triangle may be beside or behind the camera, unseen.
            closest = 1 / max(float(drawn.inverse_depth.max()), 1e-30)
            cosine = self.facing(view, self.centre[rows], self.normal[rows])
            pixels = np.sqrt(view.fx * view.fy * np.clip(cosine, 0, 1)) / np.maximum(z, closest)
            best[rows] = np.maximum(best[rows], pixels)
        return best


def _nearest(drawn: Drawn) -> NDArray[np.float32]:
    """(H, W) the least depth of the mesh in a pixel and those beside it; inf without any. A
    photograph's silhouettes are not exactly those of the mesh."""
    depth = np.where(drawn.face >= 0, 1 / np.maximum(drawn.inverse_depth, 1e-30), np.inf)
    return np.asarray(minimum_filter(depth.astype(np.float32), 3, mode="nearest"))


class _Baker:
    """The texels of an atlas, ordered by triangle."""

    def __init__(self, sight: _Sight, atlas: Atlas):
        self._sight, self._atlas = sight, atlas
        width, height = atlas.size
        drawn = draw_triangles(atlas.uv, np.ones(len(atlas.uv)), atlas.faces, width, height)
        texel = np.flatnonzero(drawn.face.ravel() >= 0)
        face = drawn.face.ravel()[texel]
        order = np.argsort(atlas.origin[face], kind="stable")
        self._texel, face = texel[order], face[order]
        self._face = atlas.origin[face]
        self._first = np.searchsorted(self._face, np.arange(len(sight.faces) + 1))
        self._points = np.empty((len(face), 3), np.float32)
        for part in _parts(len(face)):
            row, column = np.divmod(self._texel[part], width)
            points = np.column_stack([column + 0.5, row + 0.5])
            corners = atlas.faces[face[part]]
            weights = barycentric(atlas.uv[corners], points)
            at = sight.vertices[atlas.source[corners]]
            self._points[part] = (weights[..., None] * at).sum(axis=1)

    def mean(
        self,
        photographs: Iterable[tuple[View, NDArray[np.float32], NDArray[np.bool_]]],
        threads: int,
        near: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(N, 3) mean colours of the texels over the views, and their weights (N,), 0 for texels
        that no view sees.

        Args:
            near: The means that colours should not be far from; None: any colour counts.
        """
        count = len(self._texel)
        total, weight = np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
        with ThreadPoolExecutor(max(1, threads)) as pool:
            for view, rgb, valid in photographs:
                drawn = self._sight.draw(view)
                faces = self._sight.candidates(view, drawn)
                rows = _joined_ranges(self._first[faces], self._first[faces + 1])
                add = partial(
                    self._add, view, rgb, _fading(valid), _nearest(drawn), total, weight, near
                )
                for _ in pool.map(add, (rows[part] for part in _parts(len(rows)))):
                    pass
        np.divide(total, weight[:, None], out=total, where=weight[:, None] > 0)
        return total, weight

    def _add(
        self,
        view: View,
        rgb: NDArray[np.float32],
        fading: NDArray[np.float32],
        nearest: NDArray[np.float32],
        total: NDArray[np.float32],
        weight: NDArray[np.float32],
        near: tuple[NDArray[np.float32], NDArray[np.float32]] | None,
        rows: NDArray[np.intp],
    ) -> None:
        """Add the colours of one view to the texels ``rows``."""
        sight = self._sight
        points = self._points[rows].astype(np.float64)
        normals = sight.normal[self._face[rows]]
        seen, (u, v, z) = sight.visible(view, nearest, points, normals)
        cosine = sight.facing(view, points, normals)
        seen &= cosine > LEAST_COSINE
        rows = rows[seen]
        u, v, z, cosine = (a[seen] for a in (u, v, z, cosine))
        if not len(rows):
            return
        colour = bilinear(rgb, u, v)
        share = fading[v.astype(np.intp), u.astype(np.intp)]
        resolution = (sight.voxel / z) ** 2 * view.fx * view.fy * cosine
        amount = (share * resolution**SHARPNESS).astype(np.float32)
        if near is not None:
            far = ((colour - near[0][rows]) ** 2).sum(axis=1) / (2 * 3 * SPREAD**2)
            amount *= np.exp(-far)
        weight[rows] += amount
        total[rows] += amount[:, None] * colour

    def picture(self, colours: NDArray[np.float32], seen: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """(H, W, 3) the texture with the texels' colours. Texels that are not ``seen``, and those
        between charts, have the colour of the nearest one."""
        width, height = self._atlas.size
        picture = np.zeros((height * width, 3), np.uint8)
        known = np.zeros(height * width, bool)
        picture[self._texel[seen]] = np.rint(np.clip(colours[seen], 0, 255))
        known[self._texel[seen]] = True
        if not known.any():
            return np.full((height, width, 3), 128, np.uint8)
        row, column = distance_transform_edt(
            ~known.reshape(height, width), return_distances=False, return_indices=True
        )
        return np.asarray(picture.reshape(height, width, 3)[row, column])


def bilinear(picture: NDArray[Any], u: Array, v: Array) -> NDArray[np.float32]:
    """(N, 3) colours of an (H, W, 3) picture at pixels (u, v); its border continues outside."""
    height, width = picture.shape[:2]
    x, y = np.clip(u - 0.5, 0, width - 1), np.clip(v - 0.5, 0, height - 1)
    column = np.minimum(x.astype(np.intp), max(width - 2, 0))
    row = np.minimum(y.astype(np.intp), max(height - 2, 0))
    a, b = (x - column).astype(np.float32)[:, None], (y - row).astype(np.float32)[:, None]
    right, below = np.minimum(column + 1, width - 1), np.minimum(row + 1, height - 1)
    top = picture[row, column] * (1 - a) + picture[row, right] * a
    bottom = picture[below, column] * (1 - a) + picture[below, right] * a
    return np.asarray(top * (1 - b) + bottom * b, np.float32)


def _fading(valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(H, W) 1 inside a view, falling to 0 at its border and at invalid pixels."""
    padded = np.pad(valid.astype(np.uint8), 1)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    return np.asarray(np.minimum(distance / (BORDER * min(valid.shape)), 1), np.float32)


def _joined_ranges(first: NDArray[np.intp], end: NDArray[np.intp]) -> NDArray[np.intp]:
    count = end - first
    start = np.cumsum(count) - count
    return np.asarray(np.arange(int(count.sum())) + np.repeat(first - start, count))


def _parts(count: int) -> list[slice]:
    return [slice(i, i + _TEXELS) for i in range(0, count, _TEXELS)]
