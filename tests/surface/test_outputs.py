"""Depth maps, renders, mesh and video of real Gaussians, read back from files."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

import pipeline.surface.video as video
from pipeline.config.export import Export
from pipeline.config.schema import Split, Train
from pipeline.config.video import VideoExport
from pipeline.io.videofile import read_video_facts
from pipeline.metrics.protocol import choose_protocol
from pipeline.mvs.maps import DenseMap, write_map
from pipeline.render.views import render_rgb
from pipeline.runtime.errors import UserError
from pipeline.splats.gaussians import Gaussians
from pipeline.surface.depth import DepthMaps, RenderCache
from pipeline.surface.outputs import Observed, write_rendered
from tests.surface.scenes import view_at
from tests.surface.test_files import read_glb

UP = np.array([0.0, 0.0, 1.0])
needs_ffmpeg = pytest.mark.skipif(video.find_h264() is None, reason="no ffmpeg with H.264")


@pytest.fixture(scope="module")
def ball():
    """Opaque flat Gaussians on the unit sphere."""
    i = np.arange(3000)
    z = 1 - (2 * i + 1) / len(i)
    angle = i * np.pi * (3 - np.sqrt(5))
    flat = np.sqrt(1 - z * z)
    means = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
    # From (0, 0, 1) to the normal: the disc's thin axis.
    quats = np.stack([1 + z, -means[:, 1], means[:, 0], 0 * z], axis=1)
    return Gaussians(
        torch.tensor(means, dtype=torch.float32),
        torch.log(torch.tensor([0.04, 0.04, 0.004])).repeat(len(i), 1),
        torch.tensor(quats, dtype=torch.float32),
        torch.full((len(i),), 5.0),
        torch.tensor([1.0, 0.0, -1.0]).repeat(len(i), 1)[:, None, :],
    )


@pytest.fixture
def views(tmp_path):
    """A dozen views around the ball, two with equal names but for the suffix, one masked."""
    found = []
    for i in range(12):
        a, b = i * np.pi / 6, (-0.9, 0.0, 0.9)[i % 3]
        centre = 3 * np.array([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)])
        name = f"a/{i:02d}.jpg" if i != 1 else "a/00.png"
        photo = tmp_path / f"{i}.png"
        Image.fromarray(np.full((80, 80, 3), 90, np.uint8)).save(photo)
        view = view_at(centre, (0, 0, 0), 80, 80.0, name=name)
        found.append(replace(view, image=str(photo), is_test=i == 4))
    mask = np.full((80, 80), 255, np.uint8)
    mask[:40] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    found[2] = replace(found[2], mask=str(tmp_path / "mask.png"))
    return found


def look(views):
    train = Train()
    return choose_protocol(views, Split(), train).options(train, threads=2)


def test_depth_maps_and_renders_open_in_other_programs(tmp_path, ball, views):
    out = tmp_path / "out"
    write_rendered(out, Export(formats=("depths", "renders")), ball, views, look(views), up=UP)
    names = {str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()}
    assert len(names) == 3 * len(views)
    assert {"depths/median/a/00.jpg.tiff", "depths/median/a/00.png.tiff"} <= names
    assert "renders/a/05.png" in names
    for kind in ("median", "expected"):
        depth = cv2.imread(str(out / "depths" / kind / "a" / "05.tiff"), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.float32 and depth.shape == (80, 80)
        # The camera is 3 from the middle of a ball of radius 1; z, not the ray's length.
        # Light passes between the discs: the mean reaches a little deeper.
        assert abs(depth[40, 40] - 2) < 0.06
        assert depth[0, 0] == 0
    picture = np.asarray(Image.open(out / "renders" / "a" / "05.png"))
    assert picture[40, 40, 0] > 180 > 100 > picture[40, 40, 2]


def test_masks_alpha_and_test_views_in_depth_maps(tmp_path, ball, views):
    clear = np.zeros((80, 80, 4), np.uint8)
    clear[30:, :, 3] = 255
    Image.fromarray(clear).save(tmp_path / "alpha.png")
    views[3] = replace(views[3], image=str(tmp_path / "alpha.png"))
    pictures = RenderCache(ball, views, look(views), tmp_path / "drawn")
    maps = {depth.view.name: depth.depth for depth in DepthMaps(pictures)}
    assert len(maps) == len(DepthMaps(pictures)) == len(views) - 1
    assert "a/04.jpg" not in maps
    masked = maps["a/02.jpg"]
    assert (masked[:40] == 0).all() and (masked[45, 35:45] > 0).all()
    transparent = maps["a/03.jpg"]
    assert np.isinf(transparent[:30]).all() and np.isfinite(transparent[30:]).all()


def test_mesh_of_gaussians_lies_on_them(tmp_path, ball, views):
    config = Export(formats=("mesh",), mesh_voxel=0.05)
    messages = write_rendered(tmp_path, config, ball, views, look(views), up=UP)
    assert "triangles from 11 views" in messages.decisions[0] and not messages.warnings
    data = (tmp_path / "mesh.ply").read_bytes()
    count = int(data.split(b"element vertex ")[1].split()[0])
    start = data.index(b"end_header\n") + 11
    vertex = np.frombuffer(
        data, [("xyz", "<f4", 3), ("n", "<f4", 3), ("rgb", "u1", 3)], count, start
    )
    assert np.median(np.abs(np.linalg.norm(vertex["xyz"], axis=1) - 1)) < 0.05
    assert (vertex["rgb"][:, 0] > 150).mean() > 0.9, "colours of the Gaussians"
    assert "texture" in messages.decisions[1]
    data = (tmp_path / "mesh.glb").read_bytes()
    found = cv2.imdecode(np.frombuffer(data[data.index(b"\xff\xd8") :], np.uint8), 1)
    assert np.abs(found.astype(int) - 90).max() <= 3, "colours of the photographs"


def test_the_number_of_triangles_and_the_size_of_the_texture_are_options(tmp_path, ball, views):
    config = Export(formats=("mesh",), mesh_voxel=0.05, mesh_faces=700, texture_px=100)
    messages = write_rendered(tmp_path, config, ball, views, look(views), up=UP)
    assert int(messages.decisions[0].split()[1]) == pytest.approx(700, rel=0.05)
    document, _, body = read_glb((tmp_path / "mesh.glb").read_bytes())
    at = document["bufferViews"][document["images"][0]["bufferView"]]
    data = body[at["byteOffset"] :][: at["byteLength"]]
    found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert max(found.shape) <= 100


def test_confident_depths_of_multi_view_stereo_replace_rendered_ones(tmp_path, ball, views):
    """In the unit of the Gaussians, with more weight; rendered ones are in the gaps."""
    depth = np.full((80, 80), 4.2, np.float32)
    confidence = np.full((80, 80), 0.9, np.float32)
    confidence[:, :40] = 0.1
    depth[:40], confidence[:40] = 0, 0
    for view in views:
        write_map(tmp_path, view.name, DenseMap(depth, np.zeros((80, 80, 3)), confidence))
    renders = RenderCache(ball, views, look(views), tmp_path / "drawn")
    rendered = {found.view.name: found for found in DepthMaps(renders)}
    for found in DepthMaps(renders, tmp_path, 0.5):
        other = rendered[found.view.name]
        if found.view.mask is None:
            assert np.allclose(found.depth[40:, 40:], 2.1, rtol=1e-3)
        assert np.array_equal(found.depth[:40], other.depth[:40])
        assert np.array_equal(found.depth[:, :40], other.depth[:, :40])
        assert found.weight.min() == 1 and (found.weight[40:, 40:] > 4).all()
        assert other.weight is None


def test_no_surface_gives_a_warning_and_no_mesh(tmp_path, ball, views):
    faint = replace(ball, opacity_logits=torch.full((len(ball),), -6.0))
    messages = write_rendered(
        tmp_path / "out", Export(formats=("mesh",)), faint, views, look(views), up=UP
    )
    assert messages.warnings and "no mesh" in messages.warnings[0]
    assert not (tmp_path / "out" / "mesh.ply").exists()


@pytest.fixture(scope="module")
def blue_above(ball):
    """The ball, blue where z > 0."""
    colours = ball.sh.clone()
    colours[ball.means[:, 2] > 0] *= -1
    return replace(ball, sh=colours)


@pytest.mark.parametrize(
    "encoder", [video.VP9, pytest.param(video.H264, marks=needs_ffmpeg)], ids=["vp9", "h264"]
)
def test_a_video_shows_the_path_upright_in_order_at_the_size_and_rate_asked_for(
    tmp_path, blue_above, views, monkeypatch, encoder
):
    if encoder == video.VP9:
        monkeypatch.setattr(video, "find_h264", lambda: None)
    config = Export(formats=("video",), video=VideoExport(seconds=1.5, fps=8, long_side_px=96))
    for out in ("one", "two"):
        messages = write_rendered(tmp_path / out, config, blue_above, views, look(views), up=UP)
        assert encoder in messages.decisions[0]
    one, two = (tmp_path / out / "video.mp4" for out in ("one", "two"))
    assert one.read_bytes() == two.read_bytes()
    assert sorted(p.name for p in one.parent.iterdir()) == ["path.json", "video.mp4"]
    if encoder == video.H264:
        tags = b"colrnclx" + bytes((0, 1, 0, 13, 0, 1))
        assert tags in one.read_bytes(), "browsers show other colours"
    facts = read_video_facts(one)
    assert (facts.width, facts.height, facts.frames, facts.fps) == (96, 96, 12, 8)
    capture = cv2.VideoCapture(str(one))
    frames = []
    while (read := capture.read())[0]:
        frames.append(read[1][..., ::-1].astype(float))
    stored = json.loads((tmp_path / "one" / "path.json").read_text())
    camera = replace(
        views[0], width=96, height=96, **{n: stored[n] for n in ("fx", "fy", "cx", "cy")}
    )
    expected = [
        255 * render_rgb(blue_above, replace(camera, world_to_camera=np.array(pose)), look(views))
        for pose in stored["world_to_camera"]
    ]
    assert len(frames) == len(expected) == 12
    for i, frame in enumerate(frames):
        errors = [np.abs(frame - other).mean() for other in expected]
        assert errors[i] == min(errors) < 6, "colours, or the order of the frames"
        assert frame[33, 48, 2] > 180 > 80 > frame[33, 48, 0], "blue is above"
        assert frame[62, 48, 0] > 180 > 80 > frame[62, 48, 2], "red is below"


@pytest.mark.parametrize("script", ["exit 0", "echo libx264 ' libx264 '; exit 3"])
def test_ffmpeg_without_h264_is_not_used_and_its_failure_is_told(tmp_path, monkeypatch, script):
    program = tmp_path / "ffmpeg"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    frames = (np.full((64, 64, 3), shade, np.uint8) for shade in range(30))
    if script == "exit 0":
        assert video.write_video(tmp_path / "video.mp4", frames, (64, 64), 30) == video.VP9
    else:
        with pytest.raises(UserError, match="ffmpeg to encode the video, found: 3"):
            video.write_video(tmp_path / "video.mp4", frames, (64, 64), 30)


class _UpperHalf:
    """Sky in the upper half of each view."""

    def of(self, view):
        return np.indices((view.height, view.width))[0] < view.height // 2


@pytest.mark.parametrize(("columns", "is_sky"), [(0, True), (6, True), (40, False)])
def test_sky_has_no_surface_unless_photographs_match_there(tmp_path, ball, views, columns, is_sky):
    """A smooth wall that looks like sky has matches in ``columns`` of the 80."""
    depth = np.full((80, 80), 2.0, np.float32)
    confidence = np.zeros((80, 80), np.float32)
    confidence[:, :columns] = 0.9
    for view in views:
        write_map(tmp_path, view.name, DenseMap(depth, np.zeros((80, 80, 3)), confidence))
    renders = RenderCache(ball, views, look(views), tmp_path / "drawn")
    expected = {found.view.name: found for found in DepthMaps(renders, tmp_path)}
    for found in DepthMaps(renders, tmp_path, sky=_UpperHalf()):
        if found.view.mask is None:
            assert (found.depth[:, :columns] == 2).all()
            assert np.isinf(found.depth[:40, columns:]).all() == is_sky
            assert np.array_equal(found.depth[40:], expected[found.view.name].depth[40:])
    (first, *_) = DepthMaps(renders, sky=_UpperHalf())
    assert np.isinf(first.depth[:40]).all() and not np.isinf(first.depth[40:]).any()


@pytest.mark.parametrize("is_dense", [True, False])
def test_the_user_is_told_that_sky_is_left_out(tmp_path, ball, views, is_dense):
    """The photographs are grey, without a point. Stereo matches nothing; without it, a smooth wall
    could be cut away, so that nothing counts as sky."""
    nothing = DenseMap(np.zeros((80, 80), np.float32), np.zeros((80, 80, 3)), np.zeros((80, 80)))
    for view in views:
        write_map(tmp_path, view.name, nothing)
    observed = Observed(dense=tmp_path if is_dense else None, points=np.zeros((0, 3)))
    config = Export(formats=("mesh",), mesh_voxel=0.05)
    messages = write_rendered(
        tmp_path / "out", config, ball, views, look(views), up=UP, observed=observed
    )
    assert any("looks like sky" in text for text in messages.decisions) == is_dense
