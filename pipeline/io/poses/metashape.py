"""Agisoft Metashape (PhotoScan): the XML file of "File > Export > Export Cameras".

``<camera><transform>`` is camera to chunk with COLMAP's axes; ``<transform>`` of the camera's
component, in older files of the chunk, is a similarity from there to the world (geocentric for
geographic coordinates). Calibrations are those of the Metashape manual, "Camera models": cx and cy
are offsets from the image centre, pixel centres are at half integers, fx = f + b1, b2 is a skew,
and P1 and P2 are OpenCV's p2 and p1.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from pipeline.io.names import stem_key
from pipeline.io.poses.files import checked_name, find_by_head, malformed, number, numbers, read_xml
from pipeline.io.poses.frames import Lens, PosedFrame, checked_rotation, make_frame
from pipeline.io.poses.lenses import Brown, brown_camera
from pipeline.io.poses.matrices import pose_matrix
from pipeline.runtime.text import shown

Array = NDArray[np.float64]
_COEFFICIENTS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")


@dataclass(frozen=True)
class _Similarity:
    """x -> scale rotation x + translation."""

    rotation: Array
    translation: Array
    scale: float


_IDENTITY = _Similarity(np.eye(3), np.zeros(3), 1.0)


def find(folder: Path) -> str | None:
    return find_by_head(folder, ".xml", lambda head: b"<document" in head and b"<chunk" in head)


def frames(file: Path) -> list[PosedFrame]:
    """The enabled, aligned cameras of the active chunk, else of the first with any.

    Components without a transform have worlds of their own: of these the largest is used.

    Raises:
        UserError: Malformed XML, no aligned camera, or a camera that is not supported.
    """
    root = read_xml(file)
    chunks = root.findall("chunk") or root.findall("chunks/chunk")
    if not chunks:
        raise malformed(file, "expected the cameras of Metashape (<document><chunk>), found none")
    active = root.get("active_id", "")
    chunks.sort(key=lambda chunk: chunk.get("id") != active)
    for chunk in chunks:
        aligned = [
            camera
            for camera in chunk.iter("camera")
            if camera.find("transform") is not None and camera.get("enabled") not in ("false", "0")
        ]
        if aligned:
            return _of_chunk(file, chunk, aligned)
    raise malformed(file, "expected aligned cameras (<camera> with <transform>), found none")


def _of_chunk(file: Path, chunk: Element, cameras: list[Element]) -> list[PosedFrame]:
    world = _similarity(file, "the chunk's transform", chunk.find("transform")) or _IDENTITY
    components = {
        component.get("id", ""): _similarity(
            file, f"component {component.get('id', '')[:40]}", component.find("transform")
        )
        for component in chunk.iterfind("components/component")
    }
    used = Counter(camera.get("component_id", "") for camera in cameras)
    if len(used) > 1 and not all(components.get(name) for name in used):
        largest = used.most_common(1)[0][0]
        cameras = [camera for camera in cameras if camera.get("component_id", "") == largest]
    sensors = {sensor.get("id", ""): sensor for sensor in chunk.iterfind("sensors/sensor")}
    labels = _labels(chunk, cameras)
    found = []
    for camera in cameras:
        label = checked_name(file, labels[camera])
        similarity = components.get(camera.get("component_id", "")) or world
        sensor = camera.get("sensor_id", "")
        if sensor not in sensors:
            raise malformed(file, f"camera {label}: expected the sensor {shown(sensor)}")
        lens = _lens(file, f"sensor {sensor[:40]}", sensors[sensor])
        text = camera.findtext("transform", "")
        where = f"camera {label}: transform"
        pose = pose_matrix(file, where, numbers(file, where, text, 16))
        # The rotation is made exact first, so that its error does not move the centre.
        axes = checked_rotation(file, where, pose[:3, :3])
        with np.errstate(all="ignore"):
            moved = similarity.scale * similarity.rotation @ pose[:3, 3] + similarity.translation
        rotation = (similarity.rotation @ axes).T
        found.append(make_frame(file, label, lens, rotation, moved, f"camera {label}"))
    return found


def _labels(chunk: Element, cameras: list[Element]) -> dict[Element, str]:
    """The names of cameras: "group/label" for groups, if labels alone do not tell them apart."""
    labels = {camera: camera.get("label", "") for camera in cameras}
    if len({stem_key(label) for label in labels.values()}) < len(labels):
        for group in chunk.iter("group"):
            name = group.get("label", "").strip("/\\")
            for camera in group.iter("camera"):
                if camera in labels and name:
                    labels[camera] = f"{name}/{labels[camera]}"
    return labels


def _similarity(file: Path, where: str, element: Element | None) -> _Similarity | None:
    """None where the element has no rotation, as for chunks that are not georeferenced."""
    if element is None or element.find("rotation") is None:
        return None
    rotation = numbers(file, f"{where}: rotation", element.findtext("rotation"), 9)
    translation = numbers(file, f"{where}: translation", element.findtext("translation", ""), 3)
    scale = number(file, f"{where}: scale", element.findtext("scale", "1"))
    if scale <= 0:
        raise malformed(file, f"{where}: expected a positive scale, found {scale:g}")
    return _Similarity(checked_rotation(file, where, rotation.reshape(3, 3)), translation, scale)


def _lens(file: Path, where: str, sensor: Element) -> Lens:
    calibrations = sensor.findall("calibration")
    adjusted = [entry for entry in calibrations if entry.get("class") == "adjusted"]
    if not calibrations:
        raise malformed(file, f"{where}: expected a calibration, found none")
    calibration = (adjusted or calibrations)[-1]
    kind = calibration.get("type") or sensor.get("type") or "frame"
    if kind not in ("frame", "fisheye"):
        raise malformed(
            file,
            f"{where}: {kind[:40]} cameras are not supported; expected frame or fisheye cameras",
            fix="export undistorted photographs with their cameras, or set poses: ignore",
        )
    size = calibration.find("resolution")
    size = size if size is not None else sensor.find("resolution")
    width, height = (
        number(file, f"{where}: {name}", size.get(name, "") if size is not None else "")
        for name in ("width", "height")
    )
    values = _values(file, where, calibration)
    f = values["f"]
    if not f:
        raise malformed(file, f"{where}: expected a focal length (f), found none")
    lens = Brown(
        fx=f + values["b1"],
        fy=f,
        cx=width / 2 + values["cx"],
        cy=height / 2 + values["cy"],
        k=(values["k1"], values["k2"], values["k3"], values["k4"]),
        p=(values["p2"], values["p1"]),
        p_radial=(values["p3"], values["p4"]),
        skew=values["b2"],
        fisheye=kind == "fisheye",
    )
    return Lens.fixed(brown_camera(file, where, width, height, lens))


def _values(file: Path, where: str, calibration: Element) -> Mapping[str, float]:
    """The coefficients; older versions write fx, fy and skew for f, b1 and b2."""
    found = {
        name: number(file, f"{where}: {name}", calibration.findtext(name, "0"))
        for name in (*_COEFFICIENTS, "fx", "fy", "skew")
    }
    if not found["f"] and found["fy"]:
        # Their cx and cy are positions, not offsets, in files of version 1.1 and older.
        raise malformed(
            file,
            f"{where}: expected a calibration with f, found fx and fy of an old version",
            fix="export the cameras with Metashape 1.2 or newer, or set poses: ignore",
        )
    return found
