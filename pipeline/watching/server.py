"""A page in the browser that shows a scene, rendered by our own rasterizer as one moves."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.rotations import quat_to_rotation
from pipeline.geometry.up_direction import up_direction
from pipeline.render import RasterOptions
from pipeline.render.views import render_rgb, render_view, to_bytes
from pipeline.runtime.errors import UserError
from pipeline.scene.views import View
from pipeline.watching.source import Source

# Pixels of the longer side while the camera moves; then the picture is made anew in full.
MOVING_SIDE = 320
RENEW_SECONDS = 2.0


class Room:
    """The scene as the browser has it: its cameras' middle at the origin, their spread 1, so that
    neither a scene in metres from the equator nor one in millimetres is lost in float32.

    Args:
        views: the scene's cameras, at least one.
    """

    def __init__(self, views: list[View]):
        centres = np.stack([view.centre for view in views])
        self.origin = centres.mean(0)
        self.scale = float(np.linalg.norm(centres - self.origin, axis=1).max()) or 1.0

    def from_world(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """(3,) in the room, of (3,) in the world."""
        return (point - self.origin) / self.scale

    def view(
        self, wxyz: NDArray[Any], position: NDArray[Any], fov: float, size: tuple[int, int]
    ) -> View:
        """The view of a camera in the room.

        Args:
            wxyz: (4,) rotation, camera to room; x right, y down, z forward.
            position: (3,).
            fov: vertical, radians.
            size: width and height in pixels.
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
    """Width and height in pixels of a picture with this ratio and longer side."""
    width, height = (side, side / aspect) if aspect >= 1 else (side * aspect, side)
    return max(1, round(width)), max(1, round(height))


class _Visitor:
    """One browser: renders what it looks at, in a thread of its own."""

    def __init__(self, page: Page, client: Any):
        self.page, self.client = page, client
        self.wanted, self.gone = threading.Event(), False
        client.camera.on_update(lambda _: self.wanted.set())
        threading.Thread(target=self.work, daemon=True).start()
        self.wanted.set()

    def work(self) -> None:
        while not self.gone:
            self.wanted.wait()
            self.wanted.clear()
            if not self.gone:
                self.show(MOVING_SIDE)
                # Still where it was: the whole picture.
                if not self.wanted.wait(0.15):
                    self.show(self.page.side)

    def show(self, side: int) -> None:
        camera = self.client.camera
        size = picture_size(camera.aspect, side)
        view = self.page.room.view(camera.wxyz, camera.position, camera.fov, size)
        rgb = self.page.render(view)
        self.client.scene.set_background_image(rgb, format="jpeg", jpeg_quality=90)

    def leave(self) -> None:
        self.gone = True
        self.wanted.set()


class Page:
    """The server. ``stop`` ends it.

    Args:
        source: what to show; looked at every two seconds for a newer state.
        host, port: where the page is; another port is taken if this one is in use.
        side: longer side of the pictures, pixels.
        threads: of the rasterizer.

    Raises:
        UserError: viser is not installed.
    """

    def __init__(self, source: Source, *, host: str, port: int, side: int, threads: int):
        self.source, self.side = source, side
        self.options = RasterOptions(near=source.near, threads=threads)
        self.room = Room(source.views)
        self.lock = threading.Lock()
        self.visitors: dict[int, _Visitor] = {}
        self.server = _viser().ViserServer(host=host, port=port, label="splatmake", verbose=False)
        self.text = self.server.gui.add_markdown(source.shown.told)
        self.names = {view.name: view for view in source.views}
        self.choice = self.server.gui.add_dropdown("camera", tuple(self.names))
        self.choice.on_update(lambda event: self.go_to(event.client, event.target.value))
        self.place_camera()
        self.server.on_client_connect(self.welcome)
        self.server.on_client_disconnect(self.part)
        self.stopped = threading.Event()
        threading.Thread(target=self.look_for_news, daemon=True).start()

    @property
    def port(self) -> int:
        return self.server.get_port()

    def place_camera(self) -> None:
        """Begin where the second photograph was taken (the first one is held out of training),
        looking at what it sees in its middle."""
        views = self.source.views
        first = views[:2][-1]
        up = up_direction(np.stack([v.world_to_camera[:3, :3] for v in views]), [1] * len(views))
        ahead = first.centre + first.world_to_camera[2, :3] * self.render_depth(first)
        start = self.server.initial_camera
        start.position = self.room.from_world(first.centre)
        start.look_at = self.room.from_world(ahead)
        start.up = up
        start.fov = 2 * np.arctan(first.height / 2 / first.fy)
        self.server.scene.set_up_direction(up)

    def go_to(self, client: Any, name: str) -> None:
        """Put a browser's camera where this photograph was taken."""
        view, camera = self.names[name], client.camera
        ahead = view.centre + view.world_to_camera[2, :3] * self.render_depth(view)
        with client.atomic():
            camera.position = self.room.from_world(view.centre)
            camera.look_at = self.room.from_world(ahead)
            camera.fov = 2 * np.arctan(view.height / 2 / view.fy)

    def render_depth(self, view: View) -> float:
        """Typical depth in the middle of a view, in the world's unit."""
        with self.lock:
            depth = render_view(self.source.shown.gaussians, view, self.options).median_depth
        height, width = depth.shape
        middle = depth[height // 4 : -(height // 4) or None, width // 4 : -(width // 4) or None]
        seen = middle[middle > 0]
        return float(np.median(seen)) if seen.size else self.room.scale

    def render(self, view: View) -> NDArray[np.uint8]:
        with self.lock:
            rgb = render_rgb(self.source.shown.gaussians, view, self.options)
        return to_bytes(rgb)

    def welcome(self, client: Any) -> None:
        self.visitors[client.client_id] = _Visitor(self, client)

    def part(self, client: Any) -> None:
        visitor = self.visitors.pop(client.client_id, None)
        if visitor is not None:
            visitor.leave()

    def look_for_news(self) -> None:
        while not self.stopped.wait(RENEW_SECONDS):
            if self.source.renew():
                self.text.content = self.source.shown.told
                for visitor in list(self.visitors.values()):
                    visitor.wanted.set()

    def stop(self) -> None:
        self.stopped.set()
        for visitor in self.visitors.values():
            visitor.leave()
        self.server.stop()


def serve(source: Source, *, host: str, port: int, side: int, threads: int) -> None:
    """Show ``source`` until interrupted (see ``Page``)."""
    page = Page(source, host=host, port=port, side=side, threads=threads)
    print(f"open http://{host}:{page.port} (Ctrl-C ends)", flush=True)
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
            fix="pip install viser==1.1.1",
        ) from None
    return viser
