"""What a file says of itself is not believed: no false header costs time or memory, and no reason is Python's own."""

import io
import os
import random
import re
import resource
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import trimesh

from urrt_jax.io import MESH_FORMATS, WRITABLE, holds_colors, holds_normals, read_cloud, read_point_cloud, write_cloud

_READ_IN_ONE_GIGABYTE = """
import resource, sys
from urrt_jax.io import read_cloud
read_cloud(sys.argv[1], samples=1)  # imports what it needs
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 2**29, used + 2**29))
for path in sys.argv[2:]:
    try:
        print(len(read_cloud(path, samples=1)))
    except ValueError as error:
        print(error)
"""


def _pcd(count: str = "1", data: str = "ascii", points: int = 1, rows: str = "1 2 3\n") -> bytes:
    return (
        f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 {count}\nWIDTH {points}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n{rows}"
    ).encode()


def _ply(vertices: int, form: str = "binary_little_endian", rows: bytes = b"", faces: str = "") -> bytes:
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    return f"ply\nformat {form} 1.0\nelement vertex {vertices}\n{axes}{faces}end_header\n".encode() + rows


def _npy_header(shape: tuple) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return buffer.getvalue()


def _bomb() -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", _npy_header((10**6, 3)) + bytes(24 * 10**6))
    return buffer.getvalue()


def _las(**changes: tuple[int, int, int]) -> bytes:
    buffer = io.BytesIO()
    import laspy

    las = laspy.create(point_format=0, file_version="1.2")
    las.x = las.y = las.z = np.arange(5.0)
    las.write(buffer, do_compress=changes.pop("compressed", False))
    content = bytearray(buffer.getvalue())
    for start, length, value in changes.values():
        content[start : start + length] = value.to_bytes(length, "little")
    return bytes(content)


_LYING = {
    "count.pcd": (_pcd(count="1000000000"), "promises 1,000,000,002 numbers a point"),
    "points.pcd": (_pcd(points=10**9), "promises 1,000,000,000 points, more than the 100,000,000 that are read"),
    "binary.pcd": (_pcd(points=10**7, data="binary"), "promises 10000000 points of 12 bytes, it holds 0 of them"),
    "packed.pcd": (
        _pcd(points=10**7, data="binary_compressed", rows="") + b"\x64\0\0\0\x00\x0e\x27\x07" + b"x" * 100,
        "truncated or damaged; it holds 108 bytes for 120,000,000 of points",
    ),
    "face.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n1000000000 0 1 2\n", "line 6: expected a number of corners"),
    "rows.off": (b"OFF\n1000000000 0 0\n0 0 0\n", "promises 1000000000 vertices and 0 faces, it holds 1 and 0"),
    "vertices.ply": (_ply(10**9), "so 12,000,000,000 bytes or more, it holds 0"),
    "ascii.ply": (_ply(10**9, "ascii", b"1 2 3\n"), "a line each, it holds 1 lines"),
    "list.ply": (
        _ply(1, "ascii", b"1 2 3\n1000000000 0 0 0\n", "element face 1\nproperty list uint int vertex_indices\n"),
        "line 2 after its header does not hold the properties of 'face': '1000000000 0 0 0'",
    ),
    "triangles.stl": (bytes(80) + b"\xff\xff\xff\x7f" + bytes(50), "says that it holds 2,147,483,647 triangles"),
    "shape.npy": (_npy_header((10**7, 3)), "promises 240,000,000 bytes of numbers, it holds 0"),
    "bomb.npz": (_bomb(), "'points.npy' would unpack from .* to 24,000,128 bytes, more than 200 times"),
    "points.las": (_las(points=(107, 4, 10**7)), "promises 10000000 points, it holds 5"),
    "records.las": (_las(records=(100, 4, 2**32 - 1)), "puts the points at byte"),
    "points.laz": (_las(compressed=True, points=(107, 4, 10**7)), "promises 10,000,000 points, more than its"),
    "number.pts": (b"1000000000\n1 2 3\n", "line 1 promises 1,000,000,000 points, the file holds 1"),
}


@pytest.mark.skipif(sys.platform != "linux", reason="measures memory in /proc")
def test_no_false_header_costs_memory(tmp_path):
    (tmp_path / "fine.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    for name, (content, _) in _LYING.items():
        (tmp_path / name).write_bytes(content)
    files = [str(tmp_path / name) for name in ("fine.off", *_LYING)]
    command = [sys.executable, "-c", _READ_IN_ONE_GIGABYTE, *files]
    found = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert found.returncode == 0, found.stderr
    assert len(found.stdout.splitlines()) == len(_LYING), found.stdout


@pytest.mark.parametrize("name", _LYING)
def test_a_false_header_is_refused_in_words(tmp_path, name):
    content, message = _LYING[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{re.escape(name)}: .*{message}"):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("cut.pcd", _pcd(points=3, rows="1 2 3\n4 5 6\n"), "truncated; its header promises 3 points, it holds 2"),
        ("cut.pcd", _pcd(points=2, rows="1 2 3\n4 5\n"), "point 2 has 2 numbers, not the 3 of its header"),
        ("more.pcd", _pcd(points=1, rows="1 2 3\n4 5 6\n"), "damaged; its header promises 1 points, it holds 2"),
        ("twice.pcd", b"VERSION 0.7\n" + _pcd(), "a second line 'VERSION 0.7'"),
        ("some.pcd", b"VERSION 0.7\n", "no line DATA"),
        ("negative.off", b"OFF\n-5 -3 0\n0 0 0\n", "line 2: expected the numbers of vertices, faces and edges"),
        ("few.off", b"OFF\n1 0 0\n0 0 0\n1 1 1\n", "line 4: .*promises 1 vertices and 0 faces, but more follow"),
        ("few.ply", _ply(1, "ascii", b"1 2 3\n4 5 6\n"), "damaged; its header promises 1 of 'vertex'"),
        ("relative.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -3\nv 1 1 1\n", "count vertices backwards"),
        ("range.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", r"refer to vertices 1\.\.9 of 3"),
        ("short.obj", b"v 0 0 0\nv 1 0\n", "line 2: expected the 3 coordinates of a vertex, got 'v 1 0'"),
        (
            "cut.stl",
            b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n",
            "1 triangles, 1 corners",
        ),
        ("header.npy", b"\x93NUMPY\x01\x00\x10\x00{'descr':'<f8',\n ", "no valid header of NumPy's"),
        ("cut.las", _las()[:-30], "promises 5 points, it holds 3"),
        ("cut.laz", _las(compressed=True)[:-30], "truncated"),
    ],
)
def test_a_damaged_file_is_refused_in_words(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{re.escape(name)}: .*{message}"):
        read_cloud(tmp_path / name)


def test_binary_polygons_of_different_sizes_are_refused_in_words(tmp_path):
    rows = np.zeros((4, 3), "<f4").tobytes()
    faces = b"\x03" + np.arange(3, dtype="<i4").tobytes() + b"\x04" + np.arange(4, dtype="<i4").tobytes()
    header = "element face 2\nproperty list uchar int vertex_indices\n"
    (tmp_path / "mixed.ply").write_bytes(_ply(4, rows=rows + faces, faces=header))
    with pytest.raises(ValueError, match=r"mixed\.ply: .*faces with different numbers of corners"):
        read_cloud(tmp_path / "mixed.ply")


def test_a_panic_of_the_decompressor_is_a_reason(tmp_path):
    content = bytearray(_las(compressed=True))
    point_size = content.index(b"laszip encoded") + 52 + 36  # in the record that tells how the points are compressed
    assert content[point_size] == 20
    content[point_size] = 0
    (tmp_path / "cloud.laz").write_bytes(content)
    with pytest.raises(ValueError, match=r"cloud\.laz: its compressed points are damaged"):
        read_cloud(tmp_path / "cloud.laz")


def test_a_damaged_file_is_not_logged_beside_its_reason(tmp_path, caplog):
    text = trimesh.creation.box().export(file_type="stl_ascii").replace("normal 0", "normal what 0")
    (tmp_path / "box.stl").write_text(text)
    assert len(read_cloud(tmp_path / "box.stl", samples=5)) == 5  # its normals are not needed
    assert not caplog.records


@pytest.mark.parametrize("array", [np.ones((4, 3), bool), np.ones((4, 3), complex), np.full((4, 3), "a")])
@pytest.mark.parametrize("extension", ["npy", "npz"])
def test_what_is_no_number_is_no_cloud(tmp_path, array, extension):
    np.save(tmp_path / "cloud.npy", array) if extension == "npy" else np.savez(tmp_path / "cloud.npz", points=array)
    with pytest.raises(ValueError, match=r"must be numbers of shape \(N, 3\), got"):
        read_cloud(tmp_path / f"cloud.{extension}")


@pytest.mark.parametrize("key", ["points", "scan"])
def test_of_an_archive_only_the_cloud_is_read(tmp_path, monkeypatch, key):
    arrays = {"labels": np.zeros((500, 7)), key: np.ones((5, 3)), "grid": np.zeros((9, 9, 9))}
    np.savez(tmp_path / "cloud.npz", **arrays)
    read = []
    original = np.lib.format.read_array
    monkeypatch.setattr(np.lib.format, "read_array", lambda file, **kw: read.append(file.name) or original(file, **kw))
    assert read_cloud(tmp_path / "cloud.npz").shape == (5, 3)
    assert read == [f"{key}.npy"]


def test_a_well_compressed_archive_is_no_bomb(tmp_path):
    np.savez_compressed(tmp_path / "cloud.npz", points=np.zeros((500_000, 3)))
    assert read_cloud(tmp_path / "cloud.npz").shape == (500_000, 3)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "pipe.xyz")
    with pytest.raises(ValueError, match=r"pipe\.xyz: a pipe or a device, not a regular file"):
        read_cloud(tmp_path / "pipe.xyz")


def test_a_file_beyond_the_bound_is_refused(tmp_path):
    with open(tmp_path / "large.xyz", "wb") as file:
        file.truncate(4 * 2**30 + 1)  # sparse: it takes no room
    with pytest.raises(ValueError, match=r"large\.xyz: of 4,294,967,297 bytes, more than the 4,294,967,296"):
        read_cloud(tmp_path / "large.xyz")


def _contents(folder) -> dict[str, bytes]:
    """A small valid file of each format and kind."""
    rng = np.random.default_rng(0)
    points, normals = rng.normal(size=(2, 12, 3))
    colors = rng.integers(256, size=(12, 3), dtype=np.uint8)
    found = {}
    for extension in WRITABLE:
        file = folder / f"cloud{extension}"
        write_cloud(file, points, colors if holds_colors(file) else None, normals if holds_normals(file) else None)
        found[f"cloud{extension}"] = file.read_bytes()
    box = trimesh.creation.box((1, 2, 3))
    for extension in MESH_FORMATS:
        found[f"mesh{extension}"] = trimesh.exchange.export.export_mesh(box, None, extension[1:])
    found["ascii.ply"] = trimesh.exchange.ply.export_ply(box, encoding="ascii")
    found["ascii.stl"] = box.export(file_type="stl_ascii")
    found["ascii.pcd"] = _pcd(points=3, rows="1 2 3\n4 5 6\n7 8 9\n")
    found["cloud.pts"] = b"3\n1 2 3 0 9 9 9\n4 5 6 0 9 9 9\n7 8 9 0 9 9 9\n"
    return {name: content.encode() if isinstance(content, str) else content for name, content in found.items()}


def _damaged(content: bytes, rng: random.Random) -> bytes:
    """The content with one of the damages that files suffer, or that an attacker would think of."""
    lines, start = content.split(b"\n"), rng.randrange(len(content))
    end = min(len(content), start + rng.randint(1, 60))
    match rng.randrange(6):
        case 0:
            return content[:start]
        case 1:
            return content[:start] + rng.randbytes(end - start) + content[end:]
        case 2:
            return content[:start] + content[end:]
        case 3:
            return content[:end] + content[start:end] + content[end:]
        case 4:
            lines.insert(rng.randrange(len(lines)), rng.choice(lines))
            return b"\n".join(lines)
        case _:
            numbers = list(re.finditer(rb"-?\d+", content)) or [re.match(b"", content)]
            number = rng.choice(numbers)
            other = rng.choice([b"1000000000", b"-5", b"0", b"1e309", b"nan", b"99999999999999999999", b"x"])
            return content[: number.start()] + other + content[number.end() :]


def test_damaged_files_give_a_cloud_or_a_reason_that_names_them(tmp_path):
    rng = random.Random(0)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for name, content in _contents(tmp_path).items():
        for _ in range(25):
            file = tmp_path / name
            file.write_bytes(_damaged(content, rng))
            try:
                cloud = read_point_cloud(file, samples=10)
            except ValueError as error:
                assert str(error).startswith(f"{file}: "), error
            else:
                assert len(cloud.points) and np.isfinite(cloud.points).all()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**18  # kilobytes, so 256 MB
