"""Interactive page in the browser, rendered by the rasterizer of this package."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.rotations import quat_to_rotation
from pipeline.geometry.up_direction import up_direction
from pipeline.render import RasterOptions
from pipeline.render.views import render_rgb, render_view, to_bytes
from pipeline.runtime.errors import UserError
from pipeline.runtime.layout import install_extra
from pipeline.scene.views import View
from pipeline.watching.access import checked
from pipeline.watching.source import Source

# Longer side in pixels while the camera moves; afterwards the image is rendered at full size.
MOVING_SIDE = 320
POLL_SECONDS = 2.0


class ViewerFrame:
    """The frame of the browser: cameras centred at the origin and scaled to radius 1, so that
    float32 is precise enough for scenes of any unit and origin.

    Args:
        views: The scene's cameras, at least one.
    """

    def __init__(self, views: list[View]):
        centres = np.stack([view.centre for view in views])
        self.origin = centres.mean(0)
        self.scale = float(np.linalg.norm(centres - self.origin, axis=1).max()) or 1.0

    def from_world(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """(3,) point in the viewer's frame from (3,) world."""
        return (point - self.origin) / self.scale

    def view(
        self, wxyz: NDArray[Any], position: NDArray[Any], fov: float, size: tuple[int, int]
    ) -> View:
        """The view of a camera in the viewer's frame.

        Args:
            wxyz: (4,) rotation, camera to viewer's frame; x right, y down, z forward.
            position: (3,), viewer's frame.
            fov: The vertical field of view in radians.
            size: The width and height in pixels.
        """
        width, height = size
        focal = height / 2 / np.tan(fov / 2)
        pose = np.eye(4)
        pose[:3, :3] = quat_to_rotation(np.asarray(wxyz, np.float64)).T
        centre = np.asarray(position, np.float64) * self.scale + self.origin
        pose[:3, 3] = -(pose[:3, :3] * centre).sum(1)
        half = width / 2, height / 2
        return View("", "", None, width, height, focal, focal, *half, pose, False)


def picture_size(aspect: float, side: int) -> tuple[int, int]:
    """Width and height in pixels of an image with this aspect ratio and longer side."""
    width, height = (side, side / aspect) if aspect >= 1 else (side * aspect, side)
    return max(1, round(width)), max(1, round(height))


class _Client:
    """A connected browser: renders its view in a separate thread."""

    def __init__(self, page: Page, client: Any):
        self.page, self.client = page, client
        self.changed, self.closed = threading.Event(), False
        client.camera.on_update(lambda _: self.changed.set())
        threading.Thread(target=self.work, daemon=True).start()
        self.changed.set()

    def work(self) -> None:
        while not self.closed:
            self.changed.wait()
            self.changed.clear()
            if not self.closed:
                self.show(MOVING_SIDE)
                # The camera has stopped: full size.
                if not self.changed.wait(0.15):
                    self.show(self.page.side)

    def show(self, side: int) -> None:
        camera = self.client.camera
        size = picture_size(camera.aspect, side)
        view = self.page.frame.view(camera.wxyz, camera.position, camera.fov, size)
        rgb = self.page.render(view)
        self.client.scene.set_background_image(rgb, format="jpeg", jpeg_quality=90)

    def close(self) -> None:
        self.closed = True
        self.changed.set()


class Page:
    """The web server. ``stop`` ends it.

    Args:
        source: The scene, which is polled for newer states.
        host, port: The address of the page. Another port is taken if this one is in use.
        side: The longer side of the renders in pixels.
        threads: The number of threads of the rasterizer.
        allowed_hosts: Further host names of the page (see ``access.refusal``).

    Raises:
        UserError: The package viser is not installed.
    """

    def __init__(
        self,
        source: Source,
        *,
        host: str,
        port: int,
        side: int,
        threads: int,
        allowed_hosts: Collection[str] = (),
    ):
        self.source, self.side = source, side
        self.options = RasterOptions(near=source.near, threads=threads)
        self.frame = ViewerFrame(source.views)
        self.lock = threading.Lock()
        self.clients: dict[int, _Client] = {}
        viser = _viser()
        with checked(allowed_hosts):
            self.server = viser.ViserServer(host=host, port=port, label="splatmake", verbose=False)
        self.text = self.server.gui.add_markdown(source.shown.summary)
        self.names = {view.name: view for view in source.views}
        self.choice = self.server.gui.add_dropdown("camera", tuple(self.names))
        self.choice.on_update(lambda event: self.go_to(event.client, event.target.value))
        self.place_camera()
        self.server.on_client_connect(self.connect)
        self.server.on_client_disconnect(self.disconnect)
        self.stopped = threading.Event()
        threading.Thread(target=self.poll, daemon=True).start()

    @property
    def port(self) -> int:
        return self.server.get_port()

    def place_camera(self) -> None:
        """Set the initial camera to that of the second view (the first one is a test view)."""
        views = self.source.views
        first = views[:2][-1]
        up = up_direction(np.stack([v.world_to_camera[:3, :3] for v in views]), [1] * len(views))
        ahead = first.centre + first.world_to_camera[2, :3] * self.render_depth(first)
        start = self.server.initial_camera
        start.position = self.frame.from_world(first.centre)
        start.look_at = self.frame.from_world(ahead)
        start.up = up
        start.fov = 2 * np.arctan(first.height / 2 / first.fy)
        self.server.scene.set_up_direction(up)

    def go_to(self, client: Any, name: str) -> None:
        """Move the camera of a browser to that of a photograph."""
        view, camera = self.names[name], client.camera
        ahead = view.centre + view.world_to_camera[2, :3] * self.render_depth(view)
        with client.atomic():
            camera.position = self.frame.from_world(view.centre)
            camera.look_at = self.frame.from_world(ahead)
            camera.fov = 2 * np.arctan(view.height / 2 / view.fy)

    def render_depth(self, view: View) -> float:
        """Median depth of the central quarter of a view, world units."""
        with self.lock:
            depth = render_view(self.source.shown.gaussians, view, self.options).median_depth
        height, width = depth.shape
        centre = depth[height // 4 : -(height // 4) or None, width // 4 : -(width // 4) or None]
        depths = centre[centre > 0]
        return float(np.median(depths)) if depths.size else self.frame.scale

    def render(self, view: View) -> NDArray[np.uint8]:
        with self.lock:
            rgb = render_rgb(self.source.shown.gaussians, view, self.options)
        return to_bytes(rgb)

    def connect(self, client: Any) -> None:
        self.clients[client.client_id] = _Client(self, client)

    def disconnect(self, client: Any) -> None:
        connected = self.clients.pop(client.client_id, None)
        if connected is not None:
            connected.close()

    def poll(self) -> None:
        while not self.stopped.wait(POLL_SECONDS):
            if self.source.refresh():
                self.text.content = self.source.shown.summary
                for connected in list(self.clients.values()):
                    connected.changed.set()

    def stop(self) -> None:
        self.stopped.set()
        for connected in self.clients.values():
            connected.close()
        self.server.stop()


def serve(source: Source, *, host: str, port: int, **options: Any) -> None:
    """Show ``source`` until interrupted (see ``Page``)."""
    page = Page(source, host=host, port=port, **options)
    print(f"open http://{host}:{page.port} (stop with Ctrl-C)", flush=True)
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        page.stop()


def _viser() -> Any:
    try:
        import viser
    except ImportError as error:
        raise UserError(
            f"viser, which serves the page, is not installed ({error})",
            fix=install_extra("watch"),
        ) from None
    return viser
