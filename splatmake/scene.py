"""A scene: Gaussians with the views and photographs that they were trained on."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.config.schema import Evaluate
from pipeline.io import splat_files
from pipeline.io.appearance_files import read_appearance
from pipeline.io.camera_files import choose_views
from pipeline.metrics.evaluate import evaluate_views
from pipeline.metrics.protocol import choose_protocol
from pipeline.photos.load import load_view
from pipeline.plan.posed_scene import PosedScene, posed_scene
from pipeline.render.views import Render, render_view
from pipeline.runtime.errors import UserError
from pipeline.runtime.machine import usable_cores
from pipeline.runtime.progress import progress_shown
from pipeline.scene.appearance import Appearance
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.reduce import reduce_gaussians
from pipeline.surface.depth import DepthMaps, RenderCache
from pipeline.surface.files import write_mesh_glb, write_mesh_ply
from pipeline.surface.mesh import Mesh
from pipeline.surface.outputs import Messages, make_mesh, make_texture
from pipeline.surface.texture import Photographs
from splatmake.camera import Camera
from splatmake.files import warn
from splatmake.quality import Quality, quality_of


class Scene:
    """Gaussians with views and photographs of the same scene, from ``load`` or ``reconstruct``.

    Views, cameras and ``gaussians`` are in the world that the scene was trained in. Its axes are
    those of given poses; without any, z is up in scenes with GPS or ground control points, and -y
    in others. Its unit is that of given poses or the metre, unless given poses are so far from
    their origin, or in so large or small a unit, that the scene was moved and scaled. ``export``
    and ``mesh`` write files in the unit of the given poses.

    Attributes:
        folder: The folder that the scene was loaded from. In that of a finished scene,
            ``report.html`` shows the results.
        gaussians: The model, which can be replaced.
        views: All views, sorted by name.
        up: (3,) float64 unit vector, the up direction in the world.
    """

    def __init__(
        self,
        folder: Path,
        gaussians: Gaussians,
        posed: PosedScene,
        threads: int,
        appearance: Appearance | None = None,
    ):
        self.folder = folder
        self.gaussians = gaussians
        self.views: list[View] = posed.views
        self.up: NDArray[np.float64] = posed.up
        self._posed, self._train = posed, posed.train
        self._protocol = choose_protocol(posed.views, posed.split, posed.train)
        self._loaded, self._appearance = gaussians, appearance
        self._threads = threads

    def __repr__(self) -> str:
        name, tests = self.folder.absolute().name, len(self.test_views)
        return (
            f"Scene({name!r}: {len(self.gaussians):,} Gaussians, {len(self.views)} views, "
            f"{tests} test)"
        )

    @property
    def test_views(self) -> list[View]:
        """The test views, which are not used for training. There may be none."""
        return [view for view in self.views if view.is_test]

    def view(self, name: str) -> View:
        """The view with this name, which may omit the suffix.

        Raises:
            UserError: There is no such view.
        """
        return choose_views(self.views, [name], self.folder)[0]

    def render(self, camera: View | Camera) -> Render:
        """Render colours, opacity and depths, without the exposure gains and the appearance of a
        photograph.

        Args:
            camera: One of ``views``, or any camera in the scene's world.
        """
        view = camera.as_view() if isinstance(camera, Camera) else camera
        return render_view(self.gaussians, view, self._protocol.options(self._train, self._threads))

    def photograph(self, view: View) -> NDArray[np.float32]:
        """The photograph of a view at the view's size, (H, W, 3) float32 in [0, 1].

        Raises:
            UserError: The photograph's file is missing or cannot be read.
        """
        pixels = load_view(view)
        return pixels.over(self._protocol.background).astype(np.float32) / np.float32(255)

    def measure(self, views: Sequence[View] = (), *, progress: bool = False) -> Quality:
        """Render views and compare them with their photographs, with the protocol of metrics.json.

        Renders are rounded to 8 bits. Masks, exposure gains, fitted appearance and refined poses of
        test cameras are applied where the scene was trained with them. ``psnr(render.rgb,
        photograph)`` of a view applies none of these.

        Args:
            views: The views to measure; empty: the test views, or all views if there are no test
                views.
            progress: Whether to show the progress on stderr.

        Raises:
            UserError: A photograph cannot be read, or the masks leave no pixel.
        """
        kind = "chosen views" if views else "test views" if self.test_views else "training views"
        protocol = replace(
            self._protocol, views=list(views) or self._protocol.views, training_views=[]
        )
        with tempfile.TemporaryDirectory() as renders, progress_shown(progress):
            found = evaluate_views(
                self.gaussians,
                protocol,
                Evaluate(),
                self._train,
                Path(renders),
                gains=self._posed.gains,
                # The appearance of other Gaussians is not known.
                appearance=self._appearance if self.gaussians is self._loaded else None,
                threads=self._threads,
            )
        warn(found.warnings)
        return quality_of(found, kind)

    def export(
        self,
        file: str | PathLike[str],
        *,
        sh_degree: int = 3,
        min_opacity: float = 0.0,
        morton_order: bool = True,
    ) -> None:
        """Write the Gaussians in the format of the file's suffix: .ply, .spz, .sog,
        .splat, .glb or .npz.

        With the default options, a file is the same as that of the export stage. Coordinates are in
        the unit of given poses, in .npz files in that of ``gaussians``. A warning names what the
        format does not hold.

        Args:
            sh_degree: The largest degree of the spherical harmonics, 0 to 3.
            min_opacity: Gaussians with a lower opacity, 0 to 1, are left out.
            morton_order: Whether to sort Gaussians along a Z-order curve, which makes files
                smaller.

        Raises:
            UserError: The suffix or an option is wrong, no Gaussian is left, or the format cannot
                hold the Gaussians.
        """
        path = Path(file)
        splat_files.check_suffix(path)
        if sh_degree not in range(4):
            raise UserError(f"sh_degree: expected 0, 1, 2 or 3, found {sh_degree}", file=path)
        if not 0 <= min_opacity <= 1:
            raise UserError(f"min_opacity: expected 0 to 1, found {min_opacity}", file=path)
        arrays = self.gaussians.as_arrays()
        if splat_files.is_exported(path):
            arrays = arrays.scaled(1 / self._posed.unit.scale)
        reduced = reduce_gaussians(arrays, sh_degree, min_opacity, morton_order)
        warn(splat_files.write_gaussians(path, reduced, antialias=self._train.antialias))

    def mesh(
        self,
        file: str | PathLike[str],
        *,
        voxel: float | None = None,
        faces: int | None = None,
        progress: bool = False,
    ) -> Mesh:
        """Make a triangle mesh from the Gaussians' depths in the training views, write it as .ply
        with vertex colours or as .glb with a texture from the photographs, and return it.

        The mesh of the export stage also uses depths of multi-view stereo.

        Args:
            voxel: The side of a voxel in the unit of the file, which is that of given poses; None
                for 2.5 pixels at the median depth. It is enlarged, with a warning, if the mesh
                would need too much memory.
            faces: The number of triangles; None for an eighth of those of marching cubes.
            progress: Whether to show the progress on stderr.

        Raises:
            UserError: The suffix, ``voxel`` or ``faces`` is wrong, the views have no common
                surface, or a photograph cannot be read.
        """
        path = Path(file)
        if path.suffix.lower() not in (".ply", ".glb"):
            what = f"expected a mesh file (.ply, .glb), found the suffix {path.suffix!r}"
            raise UserError(what, file=path, fix="give the file one of these suffixes")
        if voxel is not None and not 0 < voxel < np.inf:
            raise UserError(f"voxel: expected a length above 0, found {voxel}", file=path)
        if faces is not None and faces < 4:
            raise UserError(f"faces: expected at least 4 triangles, found {faces}", file=path)
        unit = self._posed.unit
        views = [unit.view_to_given(view) for view in self.views]
        gaussians = Gaussians.sharing(self.gaussians.as_arrays().scaled(1 / unit.scale))
        options = choose_protocol(views, self._posed.split, self._train).options(
            self._train, self._threads
        )
        messages = Messages([], [])
        with tempfile.TemporaryDirectory() as folder, progress_shown(progress):
            maps = DepthMaps(RenderCache(gaussians, views, options, Path(folder)))
            made = make_mesh(maps, voxel, faces, self._threads, messages)
            said = [text.replace("export.mesh_voxel", "voxel") for text in messages.warnings]
            if made is None:
                raise UserError(*said, file=path)
            if path.suffix.lower() == ".ply":
                write_mesh_ply(path, made.mesh)
            else:
                photographs = Photographs(views, self._posed.gains)
                textured = make_texture(made, photographs, None, self._threads, messages)
                if textured is None:
                    raise UserError(messages.warnings[-1], file=path, fix="write a .ply file")
                write_mesh_glb(path, textured, self.up)
        warn(said)
        return made.mesh


def load(
    folder: str | PathLike[str],
    model: str | PathLike[str] | None = None,
    *,
    max_side: int | None = None,
    threads: int | None = None,
) -> Scene:
    """Load a finished scene (``results/NAME``), or a scene folder with poses and a model.

    Args:
        folder: The finished scene; or photographs with poses and without lens distortion.
        model: The file of Gaussians; None: those of the finished scene.
        max_side: The longer side to which larger views are reduced, in pixels; None: as in the
            finished scene, else full size.
        threads: The number of threads for rendering, which does not affect results; None: one per
            core.

    Raises:
        UserError: A scene or a file is missing, unfinished or unreadable.
    """
    folder = Path(folder)
    file = folder / "train" / "gaussians.npz" if model is None else Path(model)
    posed = posed_scene(folder, max_side, None, exported=splat_files.is_exported(file))
    if model is None and not file.is_file():
        raise UserError(
            "expected a finished scene (results/NAME), found no train/gaussians.npz",
            file=folder,
            fix="give the file of Gaussians as model, or reconstruct the photographs with "
            "splatmake.reconstruct",
        )
    found: list[str] = []
    gaussians = splat_files.read_gaussians(file, found)
    warn([*posed.warnings, *found])
    appearance = None if model is not None else read_appearance(file.parent, len(gaussians))
    return Scene(folder, gaussians, posed, threads or usable_cores(), appearance)
