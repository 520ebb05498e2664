"""PLY files of splats: what is written is read, by other readers too, and hostile files are errors by name."""

import numpy as np
import pytest
import torch
from splat_objects import random_gaussians

from torch_mpm import splats
from torch_mpm.splats import ply

FORMS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


def columns(count: int, degree: int = 3) -> dict[str, np.ndarray]:
    """Random but valid properties by name, in the usual order, with one more that is ignored."""
    rng = np.random.default_rng(0)
    names = [*ply.names_of((degree + 1) ** 2), "label"]
    return {name: rng.normal(size=count).astype(np.float32) for name in names}


def save(
    path,
    values: dict[str, np.ndarray],
    form: str = "binary_little_endian",
    kinds: dict[str, str] | None = None,
    count=None,
):
    """Written without torch_mpm."""
    kinds = kinds or {}
    codes = {"float": "f4", "double": "f8", "uchar": "u1", "int": "i4"}
    order = FORMS[form]
    dtype = np.dtype([(name, order + codes[kinds.get(name, "float")]) for name in values])
    size = len(next(iter(values.values())))
    rows = np.zeros(size, dtype)
    for name, value in values.items():
        rows[name] = value
    head = f"ply\nformat {form} 1.0\ncomment made by a test\nelement vertex {size if count is None else count}\n"
    head += "".join(f"property {kinds.get(name, 'float')} {name}\n" for name in values) + "end_header\n"
    body = rows.tobytes()
    if form == "ascii":
        body = "".join(" ".join(repr(v.item()) for v in row) + "\n" for row in rows).encode()
    path.write_bytes(head.encode() + body)
    return path


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_properties_have_their_meaning(form, degree, tmp_path):
    values = columns(5, degree)
    found = splats.read(save(tmp_path / "a.ply", values, form), dtype=torch.float64)
    assert found.degree == degree
    np.testing.assert_allclose(found.x.numpy(), np.stack([values[a] for a in "xyz"], 1))
    np.testing.assert_allclose(found.opacity.numpy(), 1 / (1 + np.exp(-values["opacity"].astype(float))), rtol=1e-6)
    count = (degree + 1) ** 2
    for channel in range(3):
        np.testing.assert_allclose(found.harmonics[:, 0, channel].numpy(), values[f"f_dc_{channel}"])
        for k in range(1, count):
            expected = values[f"f_rest_{channel * (count - 1) + k - 1}"]
            np.testing.assert_allclose(found.harmonics[:, k, channel].numpy(), expected)
    w, x, y, z = (values[f"rot_{k}"].astype(float) for k in range(4))
    n = np.sqrt(w * w + x * x + y * y + z * z)
    first = np.stack([1 - 2 * (y * y + z * z) / n**2, 2 * (x * y + w * z) / n**2, 2 * (x * z - w * y) / n**2], 1)
    expected = np.exp(values["scale_0"].astype(float))[:, None] * first
    np.testing.assert_allclose(found.axes[:, :, 0].numpy(), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("degree", [0, 3])
def test_what_is_written_is_read(degree, tmp_path):
    before = random_gaussians(100, degree, torch.float32)
    path = tmp_path / "a.ply"
    size = splats.write(path, before)
    assert size == path.stat().st_size == ply.size_of(100, (degree + 1) ** 2)
    after = splats.read(path)
    for name in ("x", "harmonics", "opacity_logit"):
        assert torch.equal(getattr(after, name), getattr(before, name)), name
    scale = before.covariance.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
    assert float(((after.covariance - before.covariance) / scale).abs().max()) < 2e-6
    assert not list(tmp_path.glob("*building*"))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_the_bytes_of_a_file(degree, dtype, device, tmp_path):
    """Columns of numpy in the order of the header, for harmonics of other strides and with gradients too."""
    made = random_gaussians(40, degree, dtype).to(device)
    made = made.replace(harmonics=made.harmonics.mT.contiguous().mT)
    with_gradients = {name: getattr(made, name).clone().requires_grad_() for name in ("x", "axes", "harmonics")}
    splats.write(tmp_path / "a.ply", made.replace(**with_gradients))
    deviation, quaternion = made.factors()
    parts = (made.x, 0 * made.x, made.harmonics, made.opacity_logit[:, None], deviation.log(), quaternion)
    x, normal, harmonics, *others = (part.cpu().numpy() for part in parts)
    higher = [harmonics[:, 1:, channel] for channel in range(3)]
    rows = np.concatenate([x, normal, harmonics[:, 0], *higher, *others], 1).astype("<f4")
    lines = [f"property float {name}" for name in ply.names_of((degree + 1) ** 2)]
    head = ["ply", "format binary_little_endian 1.0", "element vertex 40", *lines, "end_header\n"]
    assert (tmp_path / "a.ply").read_bytes() == "\n".join(head).encode() + rows.tobytes()


def test_meshio_reads_what_is_written(tmp_path):
    meshio = pytest.importorskip("meshio")
    before = random_gaussians(7, 1, torch.float32)
    splats.write(tmp_path / "a.ply", before)
    found = meshio.read(tmp_path / "a.ply")
    np.testing.assert_array_equal(found.points, before.x.numpy())
    np.testing.assert_array_equal(found.point_data["f_rest_4"], before.harmonics[:, 2, 1].numpy())
    assert list(found.point_data) == ply.names_of(4)[3:]


def test_an_opaque_gaussian_stays_finite(tmp_path):
    """The opacity of a logit of 40 is 1 in float32, and has no logit. A deviation of 0 has a finite logarithm."""
    before = random_gaussians(1, 0, torch.float32).replace(opacity_logit=torch.tensor([40.0]))
    flat = splats.deformed(before, before.x, torch.diag(torch.tensor([1.0, 1.0, 0.0]))[None])
    splats.write(tmp_path / "a.ply", flat)
    after = splats.read(tmp_path / "a.ply")
    assert after.opacity_logit.tolist() == [40.0]
    torch.testing.assert_close(after.covariance, flat.covariance)


def changed(name: str, value: float, row: int = 2) -> dict[str, np.ndarray]:
    values = columns(4, 1)
    values[name][row] = value
    return values


def without(*names: str) -> dict[str, np.ndarray]:
    return {name: value for name, value in columns(4, 1).items() if name not in names}


ZERO = {**columns(4, 1), **{f"rot_{k}": np.float32([1, 0, 1, 1]) for k in range(4)}}


@pytest.mark.parametrize(
    ("values", "options", "message"),
    [
        (changed("opacity", np.inf), {}, "the property opacity must be finite, got inf in vertex 2"),
        (changed("opacity", -np.inf), {}, "the property opacity must be finite, got -inf in vertex 2"),
        (changed("y", np.nan), {}, "the property y must be finite, got nan in vertex 2"),
        (changed("f_rest_3", np.nan), {"form": "ascii"}, "the property f_rest_3 must be finite, got nan in vertex 2"),
        (changed("scale_1", 21.0), {}, "vertex 2 has a scale, the logarithm of a deviation, outside -40 to 20"),
        (changed("scale_1", -300.0), {}, "vertex 2 has a scale, the logarithm of a deviation, outside -40 to 20"),
        (ZERO, {}, "vertex 1 has a quaternion rot_0, ..., rot_3 of zeros"),
        (without("opacity", "rot_3"), {}, "lack the properties opacity, rot_3"),
        (without("f_rest_8"), {}, "it must have 0, 9, 24 or 45 properties f_rest_0, f_rest_1, ..., got 8"),
        ({**without("f_rest_8"), "f_rest_9": np.zeros(4)}, {}, "it must have 0, 9, 24 or 45 properties"),
        (columns(4, 1), {"kinds": {"opacity": "uchar"}}, "the property opacity must be float or double, got uint8"),
        (
            {**columns(4, 1), "opacity": np.ones(4)},
            {"kinds": {"opacity": "int"}, "form": "ascii"},
            "the property opacity must be float or double, got int32",
        ),
        (columns(4, 1), {"count": 10**12}, "1000000000000 vertices do not fit in its"),
        (columns(4, 1), {"count": 10**12, "form": "ascii"}, "1000000000000 vertices do not fit in its"),
        (columns(4, 1), {"count": -1}, "the number of its vertices must be a whole number, got '-1'"),
        (columns(4, 1), {"count": 0}, "it has no vertices"),
        (columns(4, 1), {"count": 5}, "5 vertices do not fit"),
    ],
)  # fmt: skip
def test_hostile_files_are_named(values, options, message, tmp_path):
    path = save(tmp_path / "bad.ply", values, **options)
    with pytest.raises(ValueError, match="bad.ply.*" + message.replace("...", r"\.\.\.")):
        splats.read(path)


@pytest.mark.parametrize(
    ("line", "replaced", "message"),
    [
        ("property float opacity", "property list uchar float opacity", "unknown line: 'property list uchar float"),
        ("property float opacity", "property quad opacity", "unknown line"),
        ("property float opacity", "property float x", "have the property x twice"),
        ("element vertex 2", "element chunk 2", "first element must be vertex, got chunk"),
        ("element vertex 2", "element vertex two", "must be a whole number, got 'two'"),
        ("end_header", "end_head", "unknown line"),
        ("ply\n", "plyx\n", "does not begin with 'ply'"),
        ("format binary_little_endian 1.0\n", "", "no line with the format"),
    ],
)  # fmt: skip
def test_hostile_headers_are_named(line, replaced, message, tmp_path):
    path = save(tmp_path / "bad.ply", columns(2, 0))
    path.write_bytes(path.read_bytes().replace(line.encode(), replaced.encode(), 1))
    with pytest.raises(ValueError, match=message):
        splats.read(path)


def test_a_file_of_another_format_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"splats file must end in \.ply, got .*points\.csv"):
        splats.read(tmp_path / "points.csv")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        splats.read(tmp_path / "none.ply")


def test_gaussians_that_are_not_finite_are_not_written(tmp_path):
    bad = random_gaussians(3)
    bad.x[1, 0] = torch.nan
    with pytest.raises(ValueError, match=r"a\.ply must be finite, and number 1 is not"):
        splats.write(tmp_path / "a.ply", bad)
    assert not list(tmp_path.iterdir())
