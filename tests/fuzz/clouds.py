"""Point clouds."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.io.clouds.e57_points import read_e57
from pipeline.io.clouds.las_points import count_las, read_las
from pipeline.io.clouds.text_points import read_text
from tests.fuzz.reader import Files, Reader, of_file
from tests.io.clouds.written_e57 import (
    assembled,
    data_packet,
    pack_e57,
    points_xml,
    section,
    unpack_e57,
)

XYZ = b"# x y z r g b\n" + b"".join(b"%d.5 %d 1e2 255 0 %d\n" % (i, -i, i) for i in range(20))


def las_seeds() -> Sequence[Files]:
    import laspy

    cloud = laspy.create(point_format=3, file_version="1.2")
    cloud.x, cloud.y, cloud.z = np.arange(20.0), np.arange(20.0) / 2, np.ones(20)
    stream = io.BytesIO()
    cloud.write(stream)
    return [{"points.las": stream.getvalue()}]


def read_las_points(file: Path) -> object:
    count_las(file)
    return list(read_las(file))


def e57_seeds() -> Sequence[Files]:
    """Floats in two packets, and integers of eleven bits with colours and invalid states."""
    xyz = np.random.default_rng(0).normal(size=(20, 3))
    names = ("cartesianX", "cartesianY", "cartesianZ")
    floats = "".join(f'<{name} type="Float" precision="single"/>' for name in names)
    packets = b"".join(
        data_packet(*(part[:, i].astype("<f4").tobytes() for i in range(3)))
        for part in (xyz[:8], xyz[8:])
    )
    whole = "".join(
        f'<{name} type="ScaledInteger" minimum="-1024" maximum="1023" scale="0.01"/>'
        for name in names
    )
    whole += "".join(
        f'<{name} type="Integer" minimum="0" maximum="{high}"/>'
        for name, high in (
            *((f"color{c}", 255) for c in ("Red", "Green", "Blue")),
            ("cartesianInvalidState", 2),
        )
    )
    fields = [bytes(range(k, 28 + k)) for k in range(3)]
    fields += [bytes(range(20))] * 3 + [bytes((0, 0, 0, 4, 0))]
    return [
        {"points.e57": assembled(points_xml(xml, 20), section(body))}
        for xml, body in ((floats, packets), (whole, data_packet(*fields)))
    ]


CLOUDS: dict[str, Reader] = {
    "xyz": Reader(lambda: [{"points.xyz": XYZ}], of_file(lambda file: list(read_text(file)))),
    "las": Reader(las_seeds, of_file(read_las_points), weight=0.3),
    "e57": Reader(
        e57_seeds, of_file(lambda file: list(read_e57(file))), unpack_e57, pack_e57, weight=0.3
    ),
}
