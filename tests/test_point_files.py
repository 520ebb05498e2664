"""Files of points as other programs write them: separators, names of columns, comments, PLY; and what is refused."""

import warnings

import numpy as np
import pytest
import torch

from torch_mpm.geometry import point_files, seed

X = np.array([[0.5, -1.25, 3e-3], [2.0, 4.5, -7.0], [0.0, 1e3, 0.25]])
V = np.array([1.0, 2.0, 3.5])


def table(columns, head="", mark=",", end="\n"):
    return head + end.join(mark.join(f"{a!r}" for a in row) for row in np.stack(columns, 1).tolist()) + end


def expect(path, dim=None, axes=3, volume=V):
    found = point_files.read(path, dim)
    np.testing.assert_array_equal(found.x, X[:, :axes])
    assert (found.volume is None) == (volume is None)
    if volume is not None:
        np.testing.assert_array_equal(found.volume, volume)
    return found


MARKS = {"comma": ",", "comma and space": ", ", "semicolon": ";", "tab": "\t", "spaces": "  "}
AXES = list(X.T)


@pytest.mark.parametrize("mark", MARKS.values(), ids=MARKS)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_rows_without_names(mark, end, tmp_path):
    path = tmp_path / "points.csv"
    for columns, dim, axes, volume in (
        (AXES, None, 3, None),
        ([*AXES, V], None, 3, V),
        (AXES, 3, 3, None),
        ([*AXES, V], 3, 3, V),
        (AXES[:2], None, 2, None),
        (AXES[:2], 2, 2, None),
        ([*AXES[:2], V], 2, 2, V),
    ):
        path.write_bytes(table(columns, mark=mark, end=end).encode())
        expect(path, dim, axes, volume)


@pytest.mark.parametrize("mark", MARKS.values(), ids=MARKS)
@pytest.mark.parametrize(
    "names",
    [
        ["x", "y", "z"],
        ["X", "Y", "Z"],
        ['"Points:0"', '"Points:1"', '"Points:2"'],
        ["Points_0", "Points_1", "Points_2"],
        ["position_x", "position_y", "position_z"],
        ["Position.X", "Position.Y", "Position.Z"],
        ["position[0]", "position[1]", "position[2]"],
        ["coords:0", "coords:1", "coords:2"],
        ["x[m]", "y[m]", "z[m]"],
        ["X(m)", "Y(m)", "Z(m)"],
    ],
    ids=lambda names: names[0],
)
def test_rows_with_names(names, mark, tmp_path):
    """In any order, among other columns, and in a comment."""
    path = tmp_path / "points.csv"
    other = np.arange(3.0)
    path.write_text(
        table([V, AXES[2], other, *AXES[:2]], mark.join(["Volume", names[2], "id", *names[:2]]) + "\n", mark)
    )
    expect(path)
    path.write_text(table([other, *AXES], mark.join(["velocity_x", *names]) + "\n", mark))
    expect(path, volume=None)
    path.write_text(table([*AXES[:2], V], mark.join([*names[:2], "volume"]) + "\n", mark))
    expect(path, axes=2)
    path.write_text(
        table([*AXES[:2], V], "# written by a program\n# " + mark.join([*names[:2], "volume"]) + "\n", mark)
    )
    expect(path, axes=2)


def test_comments_spaces_and_units_of_names(tmp_path):
    path = tmp_path / "points.txt"
    rows = table(AXES, mark=" ").splitlines()
    path.write_text(
        f"\ufeff# x and y\n% three points\n\n  {rows[0]}  # the first\n// more\n{rows[1]}\n\n{rows[2]}\n", "utf-8"
    )
    expect(path, volume=None)
    path.write_text(table([*AXES, V], "x [m],y [m],z [m],volume [m^3]\n"))
    expect(path)
    path.write_text(table(AXES, "x,y,position_x\n"))  # a second family of names
    expect(path, axes=2, volume=None)


def test_z_that_is_the_same_everywhere_is_left_out_in_two_dimensions(tmp_path):
    """As programs write points of a plane."""
    path = tmp_path / "points.csv"
    path.write_text(table([*AXES[:2], np.full(3, 0.5)], '"Points:0","Points:1","Points:2"\n'))
    expect(path, 2, 2, None)
    np.save(tmp_path / "points.npy", np.column_stack([X[:, :2], np.zeros(3)]))
    assert seed.file(tmp_path / "points.npy", 1.0, dim=2).x.shape == (3, 2)
    np.save(tmp_path / "points.npy", X)
    with pytest.raises(ValueError, match=r"must have shape \[P, 2\] with P > 0, got \[3, 3\]"):
        seed.file(tmp_path / "points.npy", 1.0, dim=2)


@pytest.mark.parametrize(
    "text,dim,message",
    [
        ("1,2,3,4,5\n", None, "rows have 5 numbers without names, not 2 or 3 or 4: name the columns"),
        ("1,2\n", 3, "rows have 2 numbers without names, not 3 or 4"),
        ("1,2,3,4\n", 2, "rows have 4 numbers without names, not 2 or 3"),
        ("1,2,3\n4,5\n", None, "columns"),
        ("1,2,3\n4,5,6,7\n", None, "columns"),
        ("1,2,3\n4,five,6\n", None, "five"),
        ("x,y,z\n0,5,0,3,1,2\n", None, r"names 3 columns .* has 6 numbers in a row"),
        ("0,5\t1,5\t2,5\n", None, "its first line must be numbers or name the columns"),
        ("1.000,5;1,5;2,5\n", None, "its first line must be numbers or name the columns"),
        ("a,b,c\n1,2,3\n", None, r"its first line must be numbers or name the columns .* got \['a', 'b', 'c'\]"),
        ("x,y,x\n1,2,3\n", None, "has two columns"),
        ("x,y,volume,vol\n1,2,3,4\n", None, "has two columns"),
        ("x [mm],y [mm]\n1,2\n", None, r"the column 'x \[mm\]' must be in m"),
        ("x,y,volume [l]\n1,2,3\n", None, r"the column 'volume \[l\]' must be in m\^3"),
        ("x,y,z\n", None, "no rows of numbers"),
        ("\n", None, "no rows of numbers"),
    ],
)
def test_tables_that_are_refused(text, dim, message, tmp_path):
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"points file .*points.csv cannot be read: .*{message}"):
        point_files.read(path, dim)


HEAD = """ply
format {form} 1.0
comment of a scanner
element vertex 3
property {real} x
property {real} y
property {real} z
property uchar red
property float intensity
{volume}element face 1
property list uchar int vertex_indices
end_header
"""
FORMS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}


def ply(path, form, real="double", volume=True, cut=0):
    order, kind = FORMS[form] or "<", {"double": "f8", "float": "f4", "float32": "f4"}[real]
    names = ["x", "y", "z"]
    fields = [(n, order + kind) for n in names] + [("red", "u1"), ("intensity", order + "f4")]
    fields += [("volume", order + kind)] if volume else []
    rows = np.zeros(3, fields)
    for name, column in zip(
        [*names, "red", "intensity", "volume"], [*AXES, [1, 200, 255], [0.5, 0.25, 4.0], V], strict=True
    ):
        if name in rows.dtype.names:
            rows[name] = column
    head = HEAD.format(form=form, real=real, volume=f"property {real} volume\n" if volume else "").encode()
    body = rows.tobytes() + b"\x03" + np.arange(3, dtype=order + "i4").tobytes()
    if form == "ascii":
        body = ("\n".join(" ".join(str(a) for a in row) for row in rows.tolist()) + "\n3 0 1 2\n").encode()
    path.write_bytes(head + (body[:-cut] if cut else body))
    return path


@pytest.mark.parametrize("mark", ["# ", "#", "% ", "// ", "# columns: ", "# Columns: x y\n# "])
@pytest.mark.parametrize("names", ["z y x", "y x z", "x vx y vy", "id z x y", "x y z mass", "volume z y x"])
def test_names_in_a_comment_in_any_order(names, mark, tmp_path):
    columns = names.split()
    path = tmp_path / "points.txt"
    path.write_text(
        f"{mark}{names}\n" + "".join(" ".join(str(10 * r + k) for k in range(len(columns))) + "\n" for r in (1, 2))
    )
    found = point_files.read(path)
    axes = [columns.index(axis) for axis in "xyz" if axis in columns]
    np.testing.assert_array_equal(found.x, [[10 * r + k for k in axes] for r in (1, 2)])
    assert (found.volume is None) == ("volume" not in columns)
    assert found.volume is None or found.volume.tolist() == [10.0, 20.0]


@pytest.mark.parametrize(
    "names",
    [
        "# z [m] y [m] x [m]",
        "# z (m)   y (m)   x (m)",
        "# z/m, y/m, x/m",
        "z [m] y [m] x [m]",
        "% z_m y_m x_m",
        "z_m,y_m,x_m",
    ]
    + ["# Columns = z, y, x", "# fields: z, y, x", "#columns:z,y,x", "# names : z y x"],
)
@pytest.mark.parametrize("separator", [" ", ","])
def test_names_with_units_and_headings(names, separator, tmp_path):
    path = tmp_path / "points.txt"
    path.write_text(names + "\n" + separator.join("012") + "\n")
    assert point_files.read(path).x.tolist() == [[2.0, 1.0, 0.0]]


@pytest.mark.parametrize("form", ["{} [mm]", "{} (mm)", "{}_mm", "{}/mm", "{} / cm", "{}_cm"])
@pytest.mark.parametrize("mark", ["# ", "% ", ""])
@pytest.mark.parametrize("separator", [" ", ", "])
def test_units_other_than_metres_are_refused(form, mark, separator, tmp_path):
    if " / " in form and separator == " ":
        form = form.replace(" ", "")
    path = tmp_path / "points.txt"
    path.write_text(mark + separator.join(form.format(axis) for axis in "xyz") + "\n" + separator.join("012") + "\n")
    with pytest.raises(ValueError, match=r"the column 'x.*' must be in m"):
        point_files.read(path)


@pytest.mark.parametrize("head", ["x;y;z\n", "x [m];y [m];z [m];\n", ""])
@pytest.mark.parametrize("row", ["0,5;-1,25;2,5e1", "0,5; -1,25; 25", "0.5;-1.25;25", '"0,5";"-1,25";"25,0"'])
def test_decimal_commas_between_semicolons(head, row, tmp_path):
    path = tmp_path / "points.csv"
    path.write_text(f"{head}{row}\n{row};\n")
    assert point_files.read(path).x.tolist() == [[0.5, -1.25, 25.0]] * 2


@pytest.mark.parametrize("rows", [3, 4])
def test_prose_in_a_comment_names_no_columns(rows, tmp_path):
    path = tmp_path / "points.txt"
    path.write_text(f"# y over x{' here' * (rows - 3)}\n" + " ".join(map(str, range(rows))) + "\n")
    assert point_files.read(path).x.tolist() == [[0.0, 1.0, 2.0]]


@pytest.mark.parametrize("head", ["x,y,z\n", "x,y,z,\n", ""])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_encodings_and_separators_at_the_ends_of_lines(head, encoding, tmp_path):
    path = tmp_path / "points.csv"
    path.write_bytes(f"# Höhe [m³]\n{head}0,1,2,\n3,4,5,\n".encode(encoding))
    assert point_files.read(path).x.tolist() == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]


def test_texts_in_other_columns(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text('name,x,y,z,fixed\n"a, b",0,1,2,True\n"c",3,4,5,False\n')
    assert point_files.read(path).x.tolist() == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]


@pytest.mark.parametrize("head", ["x,y,z\n", ""])
@pytest.mark.parametrize(("row", "count"), [("3,4", 2), ("3,4,5,6", 4), ("3,,4,5", 4), ('"3",4,5,6', 4), ("7", 1)])
def test_a_row_of_another_length(head, row, count, tmp_path):
    """A decimal comma would shift the columns that follow it."""
    path = tmp_path / "points.csv"
    path.write_text(f"{head}0,1,2\n\n# a comment\n{row}\n")
    line = head.count("\n") + 4
    with pytest.raises(ValueError, match=f"line {line} has {count} columns, and the first row of numbers has 3"):
        point_files.read(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"0 1 2": "0 1 2 9"}, "number of columns changed|its rows have 4 numbers"),
        ({"0 1 2": "0 1 2 9", "3 4 5": "3 4 5 9"}, "its rows have 4 numbers, not 3"),
        ({"0 1 2\n": "0 1 2 "}, "its rows have 6 numbers, not 3"),
        ({"format ascii 1.0\n": ""}, "its header has no line with the format"),
        ({"comment": "comment Höhe", "0 1 2": "\n0 1 2\n"}, ""),
    ],
)
def test_rows_of_text_in_a_ply(changes, message, tmp_path):
    text = "ply\nformat ascii 1.0\ncomment\nelement vertex 2\n"
    text += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n0 1 2\n3 4 5\n"
    for old, new in changes.items():
        text = text.replace(old, new)
    path = tmp_path / "points.ply"
    path.write_text(text, encoding="utf-8")
    if message:
        with pytest.raises(ValueError, match=message):
            point_files.read(path)
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert point_files.read(path).x.tolist() == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("real", ["double", "float", "float32"])
def test_ply(form, real, tmp_path):
    found = point_files.read(ply(tmp_path / "points.PLY", form, real))
    exact = real == "double"
    np.testing.assert_allclose(found.x, X, rtol=0 if exact else 1e-7)
    assert found.x.dtype == found.volume.dtype == np.float64 and found.volume.tolist() == V.tolist()
    assert found.fields["red"].tolist() == [1, 200, 255] and found.fields["intensity"].tolist() == [0.5, 0.25, 4.0]
    assert sorted(found.fields) == ["intensity", "red"]
    points = seed.file(ply(tmp_path / "other.ply", form, volume=False), volume=6.0, dtype=torch.float64)
    np.testing.assert_array_equal(points.x, X)
    assert points.volume.tolist() == [2.0] * 3


def test_ply_of_another_program(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.PointCloud(X, colors=np.full((3, 4), 9, dtype=np.uint8)).export(tmp_path / "cloud.ply")
    found = point_files.read(tmp_path / "cloud.ply")
    np.testing.assert_allclose(found.x, X, rtol=1e-6)
    assert found.fields["red"].tolist() == [9, 9, 9]


@pytest.mark.parametrize("form", FORMS)
def test_ply_that_is_refused(form, tmp_path):
    path = tmp_path / "points.ply"
    whole = ply(path, form).read_bytes()
    for old, new, message in (
        (b"ply\n", b"plx\n", "does not begin with 'ply'"),
        (b"vertex 3", b"vertex 300000000000", "do not fit in its"),
        (b"vertex 3", b"vertex 0", "it has no vertices"),
        (b"property double x\n", b"property double u\n", "must have the properties x, y and z, got"),
        (b"property double x\n", b"property list uchar int x\n", "unknown line: 'property list uchar int x'"),
        (b"property double x\n", b"property half x\n", "unknown line: 'property half x'"),
        (form.encode(), b"binary", "unknown line: 'format binary 1.0'"),
        (b"element vertex 3", b"element face 1\nelement vertex 3", "its first element must be vertex, got face"),
        (b"end_header", b"", ""),
    ):
        path.write_bytes(whole.replace(old, new, 1))
        with pytest.raises(ValueError, match=f"cannot be read: .*{message}"):
            point_files.read(path)
    with pytest.raises(ValueError, match="cannot be read"):
        point_files.read(ply(path, form, cut=60))


@pytest.mark.parametrize("form", FORMS)
def test_other_properties_are_fields_of_the_points(form, tmp_path):
    """In their order, so that they are those of the particles with these ids."""
    points = seed.file(ply(tmp_path / "scan.ply", form))
    assert points.fields.keys() == {"red", "intensity"}
    assert points.fields["red"].dtype == torch.int64 and points.fields["red"].tolist() == [1, 200, 255]
    assert points.fields["intensity"].is_floating_point() and points.fields["intensity"].tolist() == [0.5, 0.25, 4.0]
    assert seed.box((0, 0), (1, 1), 0.5).fields == {}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vertex 3": "vertex -3"}, "the number of its vertices must be a whole number, got '-3'"),
        ({"vertex 3": "vertex 3e0"}, "the number of its vertices must be a whole number, got '3e0'"),
        ({"uchar red": "uchar x"}, "its vertices have the property x twice"),
        ({" 200 ": " 256 "}, "its property red has a number that is no uint8"),
        ({" 200 ": " 20.5 "}, "its property red has a number that is no uint8"),
        ({" 200 ": " nan "}, "its property red has a number that is no uint8"),
        ({"uchar red": "list uchar uchar red"}, "its header has an unknown line: 'property list uchar uchar red'"),
    ],
)
def test_headers_and_numbers_of_a_ply_that_are_refused(changes, message, tmp_path):
    path = ply(tmp_path / "scan.ply", "ascii")
    text = path.read_text()
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        point_files.read(path)
