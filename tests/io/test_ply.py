"""PLY files: exact round trips, reading by property name, and errors on damaged files."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.io.ply import read_splat_ply, write_points_ply, write_splat_ply
from pipeline.io.splat_files import is_antialiased
from pipeline.runtime.errors import UserError
from pipeline.splats.gaussians import Gaussians
from tests.splats.samples import sample


def assert_same(found: Gaussians, expected: Gaussians) -> None:
    for name, array in found.arrays().items():
        assert array.dtype == np.float32 and array.flags.c_contiguous, name
        np.testing.assert_array_equal(array, expected.arrays()[name], err_msg=name)


def header_and_body(path: Path) -> tuple[list[str], bytes]:
    head, body = path.read_bytes().split(b"end_header\n", 1)
    return head.decode().splitlines(), body


def columns_of(path: Path) -> dict[str, np.ndarray]:
    """Columns by property name, read independently of the code under test."""
    lines, body = header_and_body(path)
    names = [line.split()[2] for line in lines if line.startswith("property")]
    table = np.frombuffer(body, "<f4").reshape(-1, len(names))
    return {name: table[:, i] for i, name in enumerate(names)}


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("count", [0, 1, 7])
def test_round_trip_is_exact(tmp_path: Path, degree: int, count: int) -> None:
    data = sample(count, degree)
    write_splat_ply(tmp_path / "a.ply", data)
    found = read_splat_ply(tmp_path / "a.ply")
    assert_same(found, data)
    assert len(found) == count and found.sh_degree == degree


def test_layout_is_that_of_3dgs(tmp_path: Path) -> None:
    gaussians = sample(7)
    data = gaussians.arrays()
    write_splat_ply(tmp_path / "a.ply", gaussians)
    lines, body = header_and_body(tmp_path / "a.ply")
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 7"]
    assert [line.removeprefix("property float ") for line in lines[3:]] == [
        *("x", "y", "z", "nx", "ny", "nz"),
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(45)),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]
    assert len(body) == 7 * 62 * 4
    column = columns_of(tmp_path / "a.ply")
    # Channel by channel: red's 15 coefficients, then green's, then blue's.
    np.testing.assert_array_equal(column["f_rest_0"], data["sh"][:, 1, 0])
    np.testing.assert_array_equal(column["f_rest_14"], data["sh"][:, 15, 0])
    np.testing.assert_array_equal(column["f_rest_15"], data["sh"][:, 1, 1])
    np.testing.assert_array_equal(column["f_rest_44"], data["sh"][:, 15, 2])
    np.testing.assert_array_equal(column["f_dc_1"], data["sh"][:, 0, 1])
    np.testing.assert_array_equal(column["rot_0"], data["quats"][:, 0])
    assert not column["nx"].any()


def rewrite(path: Path, form: str, seed: int) -> None:
    """The same Gaussians with shuffled properties, without normals, with a comment and an unknown
    property, in another number format."""
    column = columns_of(path)
    names = [n for n in column if n not in ("nx", "ny", "nz")]
    np.random.default_rng(seed).shuffle(names)
    names.insert(3, "unknown")
    column["unknown"] = np.full(len(column["x"]), 9.0, np.float32)
    kind = {"ascii": "float", "binary_little_endian": "double", "binary_big_endian": "float32"}
    lines = ["ply", "comment by another program", f"format {form} 1.0"]
    lines += [f"element vertex {len(column['x'])}"]
    lines += [f"property {kind[form]} {name}" for name in names]
    table = np.stack([column[name] for name in names], axis=1)
    if form == "ascii":
        body = "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in table).encode()
    else:
        body = table.astype("<f8" if "little" in form else ">f4").tobytes()
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + body)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("degree", [0, 2])
def test_reads_by_name_in_any_order_and_number_format(tmp_path: Path, form, degree) -> None:
    data = sample(5, degree)
    write_splat_ply(tmp_path / "a.ply", data)
    rewrite(tmp_path / "a.ply", form, seed=degree)
    assert_same(read_splat_ply(tmp_path / "a.ply"), data)


def test_windows_line_ends_and_a_following_element_are_read(tmp_path: Path) -> None:
    data = sample(4, 1)
    write_splat_ply(tmp_path / "a.ply", data)
    lines, body = header_and_body(tmp_path / "a.ply")
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    (tmp_path / "a.ply").write_bytes("\r\n".join(lines).encode() + body + bytes([3]) + bytes(12))
    assert_same(read_splat_ply(tmp_path / "a.ply"), data)


def test_every_truncation_is_an_error_that_names_the_file(tmp_path: Path) -> None:
    write_splat_ply(tmp_path / "whole.ply", sample(2, 0))
    whole = (tmp_path / "whole.ply").read_bytes()
    cut = tmp_path / "cut.ply"
    for length in range(len(whole)):
        cut.write_bytes(whole[:length])
        with pytest.raises(UserError, match=r"expected .* found") as caught:
            read_splat_ply(cut)
        assert caught.value.file == cut and caught.value.fix


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"element vertex 2", b"element vertex 3", "of 3 Gaussians"),
        (b"element vertex 2", b"element vertex 1", "of 1 Gaussians"),
        (b"element vertex 2", b"element vertex 99999999999999999", "found"),
        (b"element vertex 2", b"element vertex -2", "element vertex"),
        (b"element vertex 2", b"element vertex two", "element vertex"),
        (b"element vertex 2", b"element face 2", "element vertex"),
        (b"element vertex 2", b"element chunk 1\nelement vertex 2", "SuperSplat's compressed"),
        (b"property float opacity\n", b"", "no opacity"),
        (b"property float x\n", b"property float y\n", "y twice"),
        (b"property float x\n", b"property list uchar float x\n", "list"),
        (b"property float x\n", b"property text x\n", "text"),
        (b"property float nx\n", b"property float f_rest_0\n", "f_rest"),
        (b"property float nx\n", b"property double nx\n", "bytes"),
        (b"property float nx\n", b"property float f_rest_7\n", "no f_rest_0"),
        (b"format binary_little_endian 1.0\n", b"", "format"),
        (b"binary_little_endian", b"binary_middle_endian", "middle"),
        (b"ply\n", b"\x89PNG\n", "begins with"),
    ],
)
def test_an_inconsistent_header_is_an_error(tmp_path: Path, old, new, message) -> None:
    path = tmp_path / "a.ply"
    write_splat_ply(path, sample(2, 0))
    changed = path.read_bytes().replace(old, new, 1)
    assert changed != path.read_bytes()
    path.write_bytes(changed)
    with pytest.raises(UserError, match=message):
        read_splat_ply(path)


@pytest.mark.parametrize("change", ["drop a line", "add a line", "drop a number", "a word"])
def test_damaged_ascii_is_an_error(tmp_path: Path, change: str) -> None:
    path = tmp_path / "a.ply"
    write_splat_ply(path, sample(3, 0))
    rewrite(path, "ascii", 0)
    lines = path.read_text().splitlines()
    if change == "drop a line":
        lines.pop()
    elif change == "add a line":
        lines.append(lines[-1])
    elif change == "drop a number":
        lines[-1] = lines[-1].rsplit(" ", 1)[0]
    else:
        lines[-1] = lines[-1].rsplit(" ", 1)[0] + " word"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(UserError, match="expected"):
        read_splat_ply(path)


def test_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be read"):
        read_splat_ply(tmp_path / "none.ply")


@pytest.mark.parametrize("with_normals", [False, True])
def test_point_cloud_layout(tmp_path: Path, with_normals) -> None:
    rng = np.random.default_rng(0)
    xyz, rgb = rng.normal(size=(6, 3)), rng.integers(0, 256, (6, 3), dtype=np.uint8)
    normals = rng.normal(size=(6, 3)) if with_normals else None
    write_points_ply(tmp_path / "p.ply", xyz, rgb, normals)
    lines, body = header_and_body(tmp_path / "p.ply")
    floats = ["x", "y", "z"] + (["nx", "ny", "nz"] if with_normals else [])
    assert lines[3:] == [f"property float {n}" for n in floats] + [
        f"property uchar {n}" for n in ("red", "green", "blue")
    ]
    size = 4 * len(floats)
    rows = np.frombuffer(body, np.uint8).reshape(6, size + 3)
    expected = xyz if normals is None else np.concatenate([xyz, normals], 1)
    np.testing.assert_array_equal(
        rows[:, :size].copy().view("<f4"), np.asarray(expected, np.float32)
    )
    np.testing.assert_array_equal(rows[:, size:], rgb)


@pytest.mark.parametrize("comment", ["SplatRenderMode: mip", "antialiased 1"])
def test_other_programs_comments_on_opacity_compensation_are_read(
    tmp_path: Path, comment: str
) -> None:
    """Brush's and Postshot's."""
    write_splat_ply(tmp_path / "a.ply", sample(2, 0))
    assert not is_antialiased(tmp_path / "a.ply")
    plain = (tmp_path / "a.ply").read_bytes()
    marked = plain.replace(b"element vertex", f"comment {comment}\nelement vertex".encode(), 1)
    (tmp_path / "b.ply").write_bytes(marked)
    assert is_antialiased(tmp_path / "b.ply")
    assert_same(read_splat_ply(tmp_path / "b.ply"), sample(2, 0))
    (tmp_path / "c.ply").write_bytes(b"ply")
    assert not is_antialiased(tmp_path / "c.ply")
