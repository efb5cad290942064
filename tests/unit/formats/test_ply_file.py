"""Elements of PLY files: those that plyfile writes, lists, and damaged or hostile headers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plyfile
import pytest

from splatbot.errors import FormatError
from splatbot.formats.ply_file import read_ply, read_ply_header, write_ply

TYPES = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]
NAMES = ["char", "uchar", "short", "ushort", "int", "uint", "float", "double"]
OTHER_NAMES = ["int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"]


def rows_of_all_types(count: int = 20) -> np.ndarray:
    """Return rows with the least, the largest and random values of each type."""
    rng = np.random.default_rng(0)
    rows = np.empty(count, [(f"p_{kind}", f"<{kind}") for kind in TYPES])
    for kind in TYPES:
        if kind[0] == "f":
            values = rng.normal(size=count).astype(kind)
            values[:3] = np.nan, np.inf, -np.inf
        else:
            limits = np.iinfo(kind)
            values = rng.integers(limits.min, limits.max, count, endpoint=True)
            values[:2] = limits.min, limits.max
        rows[f"p_{kind}"] = values
    return rows


def described(**elements: np.ndarray) -> list[plyfile.PlyElement]:
    return [plyfile.PlyElement.describe(rows, name) for name, rows in elements.items()]


def header(*lines: str, kind: str = "ascii") -> bytes:
    return "\n".join(["ply", f"format {kind} 1.0", *lines, "end_header\n"]).encode()


def refusal(path: Path, content: bytes) -> FormatError:
    """Return the refusal of the element vertex, which names the file and a fix."""
    path.write_bytes(content)
    with pytest.raises(FormatError) as caught:
        read_ply(path, ["vertex"])
    assert caught.value.file == str(path)
    assert caught.value.hint
    return caught.value


@pytest.mark.parametrize("layout", ["ascii", "<", ">"])
def test_values_of_all_types_are_those_that_plyfile_wrote(tmp_path: Path, layout: str) -> None:
    rows = rows_of_all_types()
    order = "=" if layout == "ascii" else layout
    ply = plyfile.PlyData(described(first=rows[:7], vertex=rows), text=layout == "ascii", byte_order=order)
    ply.comments, ply.obj_info = ["element of no meaning 3", "end_header"], ["by plyfile"]
    ply.write(str(tmp_path / "all.ply"))
    found = read_ply(tmp_path / "all.ply", ["vertex", "first", "absent"])
    assert list(found) == ["first", "vertex"]
    for name, wanted in (("first", rows[:7]), ("vertex", rows)):
        assert found[name].dtype.names == rows.dtype.names
        for kind in TYPES:
            assert np.array_equal(found[name][f"p_{kind}"], wanted[f"p_{kind}"], equal_nan=kind[0] == "f"), kind


def test_plyfile_reads_what_is_written(tmp_path: Path) -> None:
    rows = rows_of_all_types()
    write_ply(tmp_path / "all.ply", {"vertex": rows, "empty": rows[:0]})
    ply = plyfile.PlyData.read(str(tmp_path / "all.ply"))
    assert [p.val_dtype for p in ply["vertex"].properties] == TYPES
    assert ply["vertex"].data.tobytes() == rows.tobytes()
    assert len(ply["empty"].data) == 0


@pytest.mark.parametrize("names", [NAMES, OTHER_NAMES])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_both_names_of_types_and_both_ends_of_lines_are_read(tmp_path: Path, names: list[str], newline: str) -> None:
    properties = [f"property {name} {kind}" for name, kind in zip(names, TYPES, strict=True)]
    text = header("element vertex 1", *properties).decode() + "-1 2 -3 4 -5 6 0.5 -0.25\n"
    (tmp_path / "a.ply").write_bytes(text.replace("\n", newline).encode())
    (row,) = read_ply(tmp_path / "a.ply", ["vertex"])["vertex"].tolist()
    assert row == (-1, 2, -3, 4, -5, 6, 0.5, -0.25)


@pytest.mark.parametrize("text", [True, False])
def test_vertices_of_a_mesh_are_read_without_its_faces(tmp_path: Path, text: bool) -> None:
    vertices = np.array([(0, 1, 2), (3, 4, 5), (6, 7, 8)], [("x", "f4"), ("y", "f4"), ("z", "f4")])
    faces = np.empty(2, [("vertex_indices", "O")])
    faces["vertex_indices"] = [[0, 1, 2], [2, 1, 0, 1]]
    plyfile.PlyData(described(vertex=vertices, face=faces), text=text).write(str(tmp_path / "mesh.ply"))
    assert np.array_equal(read_ply(tmp_path / "mesh.ply", ["vertex"])["vertex"], vertices)
    with pytest.raises(FormatError, match="list vertex_indices") as caught:
        read_ply(tmp_path / "mesh.ply", ["face"])
    assert caught.value.field == "face"
    plyfile.PlyData(described(face=faces, vertex=vertices), text=text).write(str(tmp_path / "mesh.ply"))
    with pytest.raises(FormatError, match="vertices first"):
        read_ply(tmp_path / "mesh.ply", ["vertex"])


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("count", [-1, 40, 50_000_001, 2**40, 10**30])
def test_claimed_rows_beyond_the_file_are_refused(tmp_path: Path, kind: str, count: int) -> None:
    content = header(f"element vertex {count}", "property double x", "property list uchar int y", kind=kind)
    error = refusal(tmp_path / "a.ply", content + b"1 1 1\n" * 6)
    assert error.field == "vertex"


def test_a_claim_of_another_element_is_refused_too(tmp_path: Path) -> None:
    content = header("element vertex 1", "property uchar x", f"element face {2**40}", "property list uchar int i")
    assert refusal(tmp_path / "a.ply", content + b"1\n").field == "face"


@pytest.mark.parametrize(
    "lines",
    [
        ["property float x"],
        ["element vertex 1", "property half x"],
        ["element vertex 1", "property list uchar half x"],
        ["element vertex 1", "property list half uchar x"],
        ["element vertex 1", "property float x", "property float x"],
        ["element vertex 1", "property float x", "property list uchar int x"],
        ["element vertex 1", "property float x", "element vertex 1"],
        ["element vertex one", "property float x"],
        ["element vertex", "property float x"],
        ["element vertex 1", "property float"],
        ["element vertex 1", "property float x", "format ascii 1.0"],
        ["element vertex 1", "property float x", "texture of no meaning"],
    ],
)
def test_wrong_lines_of_a_header_are_quoted(tmp_path: Path, lines: list[str]) -> None:
    error = refusal(tmp_path / "a.ply", header(*lines) + b"1\n")
    assert any(f"`{line}`" in error.message for line in lines)
    assert error.field == "vertex"


@pytest.mark.parametrize(
    "lines",
    [
        [f"element e{index} 0" for index in range(65)],
        ["element vertex 0", *(f"property float p{index}" for index in range(4097))],
    ],
)
def test_headers_of_too_many_elements_or_properties_are_refused(tmp_path: Path, lines: list[str]) -> None:
    write = (tmp_path / "a.ply").write_bytes
    write(header(*lines[:-1]))
    read_ply_header(tmp_path / "a.ply")
    write(header(*lines))
    with pytest.raises(FormatError, match="more than"):
        read_ply_header(tmp_path / "a.ply")


def test_rows_do_not_change_with_the_file(tmp_path: Path) -> None:
    rows = rows_of_all_types()
    write_ply(tmp_path / "a.ply", {"vertex": rows})
    found = read_ply(tmp_path / "a.ply", ["vertex"])["vertex"]
    with (tmp_path / "a.ply").open("r+b") as file:  # in place, as `rsync --inplace` does
        file.write(bytes((tmp_path / "a.ply").stat().st_size))
    assert found.tobytes() == rows.tobytes()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"plyx\n",
        b"ply\nend_header\n",
        b"ply\nformat ascii 2.0\nend_header\n",
        b"ply\nformat ebcdic 1.0\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 0\nend_header",
        b"ply\nformat ascii 1.0\ncomment " + b"x" * 2**20 + b"\nend_header\n",
    ],
)
def test_files_without_a_sound_header_are_refused(tmp_path: Path, content: bytes) -> None:
    assert refusal(tmp_path / "a.ply", content).field in ("vertex", "format")


@pytest.mark.parametrize(
    "rows", ["", "1 2\n", "1 2\n\n3 4\n", "1 2\n3\n", "1 2\n3 4 5\n", "1 2\n3 x\n", "1 2\n3 256\n"]
)
def test_damaged_rows_of_text_are_refused(tmp_path: Path, rows: str) -> None:
    content = header("element vertex 2", "property float x", "property uchar y") + rows.encode()
    assert refusal(tmp_path / "a.ply", content).field == "vertex"


def test_elements_without_rows_or_properties_are_empty(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(header("element bare 3", "element vertex 0", "property float x"))
    found = read_ply(tmp_path / "a.ply", ["bare", "vertex"])
    assert (len(found["bare"]), found["bare"].dtype.names) == (3, ())
    assert (len(found["vertex"]), found["vertex"].dtype.names) == (0, ("x",))


def test_a_header_is_read_without_its_rows(tmp_path: Path) -> None:
    write_ply(tmp_path / "all.ply", {"vertex": rows_of_all_types()})
    (element,) = read_ply_header(tmp_path / "all.ply").elements
    assert (element.name, element.count, list(element.types.values())) == ("vertex", 20, TYPES)
    with pytest.raises(FormatError, match="No such file"):
        read_ply_header(tmp_path / "none.ply")
