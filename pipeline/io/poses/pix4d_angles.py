"""Pix4D: ``PROJECT_calibrated_external_camera_parameters.txt`` with
``PROJECT_pix4d_calibrated_internal_camera_parameters.cam``.

Each line has name, X, Y, Z, omega, phi and kappa in degrees: Rx(omega) Ry(phi) Rz(kappa) is camera
to world with OpenGL axes. The ``.cam`` file has one camera in millimetres, its principal point from
the image's upper left corner. Source: Pix4D's documentation, "How are the Internal and External
Camera Parameters defined" and "Yaw, Pitch, Roll and Omega, Phi, Kappa angles".
"""

from __future__ import annotations

import re
from pathlib import Path

from pipeline.io.poses.files import find_by_head, malformed, number, numbers, read_text
from pipeline.io.poses.frames import FLIP_YZ, Lens, PosedFrame, make_frame, turned
from pipeline.io.poses.lenses import Brown, scaled_lens
from pipeline.runtime.text import shown

_SUFFIX = "calibrated_external_camera_parameters.txt"
_CAM_SUFFIX = "pix4d_calibrated_internal_camera_parameters.cam"
_HEADER = b"imageName X Y Z Omega Phi Kappa".split()
_SENSOR = re.compile(r"sensor width of ([^\sx]{1,60})x([^\sx]{1,60})mm")
_FIELDS = ("F", "Px", "Py", "K1", "K2", "K3", "T1", "T2")


def find(folder: Path) -> str | None:
    name = find_by_head(folder, ".txt", lambda head: head.split()[:7] == _HEADER)
    return name if name is not None and len(files(folder / name)) == 2 else None


def files(path: Path) -> list[Path]:
    """The file of poses and that of the camera."""
    if not path.name.endswith(_SUFFIX):
        return [path]
    camera = path.with_name(path.name.removesuffix(_SUFFIX) + _CAM_SUFFIX)
    return [path, camera] if camera.is_file() else [path]


def frames(path: Path) -> list[PosedFrame]:
    """The images of the file.

    Raises:
        UserError: The files are malformed or describe several cameras.
    """
    _, camera = files(path)
    lens = _lens(camera)
    found = []
    for line in read_text(path).splitlines()[1:]:
        if not line.strip():
            continue
        *words, x, y, z, omega, phi, kappa = ("", *[""] * 6, *line.split())
        name = " ".join(words).strip()
        values = numbers(path, f"image {shown(name)}", [x, y, z, omega, phi, kappa], 6)
        to_world = turned(0, values[3]) @ turned(1, values[4]) @ turned(2, values[5])
        found.append(make_frame(path, name, lens, FLIP_YZ @ to_world.T, values[:3]))
    if not found:
        raise malformed(path, "expected an image in each line, found none")
    return found


def _lens(file: Path) -> Lens:
    content = read_text(file)
    sensors = _SENSOR.findall(content)
    if len(sensors) != 1:
        raise malformed(
            file,
            f"expected one camera with its sensor width, found {len(sensors)}",
            fix="use Pix4D's calibrated_camera_parameters.txt, which has each image's camera",
        )
    width_mm, height_mm = (number(file, "sensor width", text) for text in sensors[0])
    if min(width_mm, height_mm) <= 0:
        raise malformed(file, f"impossible sensor of {width_mm:g} x {height_mm:g} mm")
    pairs = [line.split() for line in content.splitlines()]
    values = {words[0]: words[1] for words in pairs if len(words) == 2}
    f, px, py, k1, k2, k3, t1, t2 = (
        number(file, name, values.get(name, "0" if name[0] in "KT" else "")) for name in _FIELDS
    )
    # The values are in sensor widths; they are multiplied by the photograph's width in pixels.
    unit = Brown(
        f / width_mm, f / width_mm, px / width_mm, py / width_mm, k=(k1, k2, k3), p=(t1, t2)
    )
    return scaled_lens(file, file.name, unit, lambda width, height: width, from_centre=False)
