"""Clouds in text, as spreadsheets and scanners' programs write them."""

import numpy as np
import pytest

from urrt_jax.io import read_point_cloud

POINTS = np.array([[1.5, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    "text",
    [
        "1.5 2 3\n4 5 6\n",
        "1.5\t2\t3\r\n4\t5\t6\r\n",
        "1.5,2,3\n4,5,6",
        "1.5, 2, 3\n4, 5, 6\n",
        "1.5;2;3\n4;5;6\n",
        "\ufeff1.5 2 3\n4 5 6\n",
        "x,y,z\n1.5,2,3\n4,5,6\n",
        "X Y Z R G B\n1.5 2 3 9 9 9\n4 5 6 9 9 9\n",
        '"z","id","y","x"\n3,a,2,1.5\n6,b,5,4\n',
        "x [m];y [m];z [m]\n1.5;2;3\n4;5;6\n",
        "2\n1.5 2 3\n4 5 6\n",
        "# made by hand\n// on a Monday\n\n1.5 2 3 7\n4 5 6 7\n",
        "//Z,Y,X\n3,2,1.5\n6,5,4\n",
        "1.5 2 3 # the first\n4 5 6\n",
    ],
)
@pytest.mark.parametrize("extension", ["xyz", "txt", "csv", "pts"])
def test_text_is_read(tmp_path, extension, text):
    (tmp_path / f"cloud.{extension}").write_bytes(text.encode())
    np.testing.assert_array_equal(read_point_cloud(tmp_path / f"cloud.{extension}").points, POINTS)


def test_utf16_is_read(tmp_path):
    (tmp_path / "cloud.csv").write_bytes("x,y,z\n1.5,2,3\n4,5,6\n".encode("utf-16"))
    np.testing.assert_array_equal(read_point_cloud(tmp_path / "cloud.csv").points, POINTS)


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("x,y,z,nx,ny,nz,r,g,b", "1,2,3,0,0,1,10,20,30"),
        ("red,green,blue,Normal_X,Normal_Y,Normal_Z,X,Y,Z", "10,20,30,0,0,1,1,2,3"),
    ],
)
def test_names_tell_normals_and_colors(tmp_path, header, row):
    (tmp_path / "cloud.csv").write_text(f"{header}\n{row}\n")
    points, normals, colors = read_point_cloud(tmp_path / "cloud.csv")
    assert (points.tolist(), normals.tolist(), colors.tolist()) == ([[1, 2, 3]], [[0, 0, 1]], [[10, 20, 30]])


@pytest.mark.parametrize("row", ["1 2 3 10 20 30", "1 2 3 -500 10 20 30"])
def test_pts_ends_with_its_colors(tmp_path, row):
    (tmp_path / "cloud.pts").write_text(f"1\n{row}\n")
    assert read_point_cloud(tmp_path / "cloud.pts").colors.tolist() == [[10, 20, 30]]


@pytest.mark.parametrize(
    ("values", "colors"),
    [("0 0.2 1", [0, 51, 255]), ("0 256 65535", [0, 1, 255]), ("0 1 1", [0, 1, 1]), ("-1 2 3", None)],
)
def test_colors_of_any_usual_scale_are_read(tmp_path, values, colors):
    (tmp_path / "cloud.txt").write_text(f"x y z r g b\n1 2 3 {values}\n")
    found = read_point_cloud(tmp_path / "cloud.txt").colors
    assert found is None if colors is None else found.tolist() == [colors]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n4 5\n", "line 2: 2 columns, but line 1 has 3"),
        ("1 2 3\n\n# so\n4 what 6\n", "line 4: expected a number, got 'what'"),
        ("1 2 3\n1_0 2 3\n", "line 2: expected a number, got '1_0'"),
        ("x,y,z,name\n1,2,3,a\n4,,6,b\n", "line 3: expected a number, got ''"),
        ("x,y,z\n1,2,3,4\n", "line 2: 4 columns, but the header names 3"),
        ("x,y,intensity\n1,2,3\n", "line 1: expected numbers, or a header with the names x, y and z"),
        ("x,y,z,x\n1,2,3,4\n", "line 1: the header names 'x' twice"),
        ("1 2\n3 4\n", "line 1: a point needs 3 numbers, got '1 2'"),
        ("1,5;2,5;3,5\n", "line 1: .* got '1,5;2,5;3,5'"),
        ("1.5;2.5;3.5\n1,5;2,5;3,5\n", "line 2: decimal commas are not read"),
        ("3\n1 2 3\n4 5 6\n", "line 1 promises 3 points, the file holds 2"),
        ("1\n1 2 3\n4 5 6\n", "line 1 promises 1 points, the file holds 2"),
        ("5\n", "line 1 promises 5 points, the file holds none"),
        ("0\n", "holds no points"),
        ("# x y z\n", "holds no points"),
        ("1 " * 40_000, "line 1: longer than 65,536 characters"),
    ],
)
def test_wrong_text_is_refused_with_its_line(tmp_path, text, message):
    (tmp_path / "cloud.txt").write_text(text)
    with pytest.raises(ValueError, match=rf"cloud\.txt: .*{message}"):
        read_point_cloud(tmp_path / "cloud.txt")
