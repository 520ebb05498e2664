"""`MPMSolver` of taichi_elements against its published step, restated in NumPy in 2-D and 3-D."""

import math

import numpy as np
import pytest
import torch

from torch_mpm.compat.taichi_elements import MPMSolver, particle_io
from torch_mpm.geometry import point_files

WATER, ELASTIC, SNOW, SAND, STATIONARY = range(5)


class Restated:
    """MLS-MPM with F moved before the law, a closed domain, and the volume J_p of water, snow and sand."""

    def __init__(self, res, x, material, velocity=0.0, water_density=1.0):
        self.dim, self.res, self.dx = len(res), np.array(res), 1 / res[0]
        self.x, self.v = x.copy(), np.zeros_like(x) + velocity
        self.material = np.broadcast_to(material, len(x)).copy()
        self.C = np.zeros((len(x), self.dim, self.dim))
        self.F = np.tile(np.eye(self.dim), (len(x), 1, 1))
        self.Jp = np.where(self.material == SAND, 0.0, 1.0)
        self.mass = self.dx**self.dim * 1000 * np.where(self.material == WATER, water_density, 1.0)
        self.mu, self.lam = 1e6 / 2.4, 1e6 * 0.2 / (1.2 * 0.6)
        self.gravity = np.array([0, -9.8, 0.0])[: self.dim]
        self.on_nodes = []

    def stress(self, dt):
        eye, result = np.eye(self.dim), np.zeros_like(self.F)
        for p, kind in enumerate(self.material):
            F = np.diag([self.Jp[p]] + [1.0] * (self.dim - 1)) if kind == WATER else self.F[p]
            F = (eye + dt * self.C[p]) @ F
            U, s, Vh = np.linalg.svd(F)
            h = 0.3 if kind == ELASTIC else math.exp(10 * (1 - self.Jp[p])) if kind == SNOW else 1.0
            if kind == SAND:
                s = self.sand(s, p)
                F = U @ np.diag(s) @ Vh
                tau = 2 * self.mu * np.log(s) + self.lam * np.log(s).sum()
                result[p], self.F[p] = U @ np.diag(tau) @ U.T, F
                continue
            new = np.clip(s, 1 - 2.5e-2, 1 + 4.5e-3) if kind == SNOW else s
            self.Jp[p] *= (s / new).prod()
            J = new.prod()
            if kind == WATER:
                self.Jp[p], F = J, np.diag([J] + [1.0] * (self.dim - 1))
            elif kind == SNOW:
                F = U @ np.diag(new) @ Vh
            mu = 0 if kind == WATER else h * self.mu
            result[p] = 2 * mu * (F - U @ Vh) @ F.T + h * self.lam * J * (J - 1) * eye
            self.F[p] = F
        return result

    def sand(self, s, p):
        sine = math.sin(math.radians(45))
        alpha = math.sqrt(2 / 3) * 2 * sine / (3 - sine)
        e = np.log(np.maximum(s, 1e-4))
        tr = e.sum() + self.Jp[p]
        hat = e - tr / self.dim
        if tr >= 0:
            self.Jp[p] = tr
            return np.ones(self.dim)
        self.Jp[p] = 0
        size = np.linalg.norm(hat) + 1e-20
        gamma = size + (self.dim * self.lam + 2 * self.mu) / (2 * self.mu) * tr * alpha
        return np.exp(e - max(0, gamma) / size * hat)

    def step(self, dt):
        stress = self.stress(dt)
        base = np.floor(self.x / self.dx - 0.5).astype(int)
        f = self.x / self.dx - base
        w = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])
        shape = tuple(self.res + 3)
        m, mv = np.zeros(shape), np.zeros((*shape, self.dim))
        volume = self.dx**self.dim
        affine = -dt * volume * 4 / self.dx**2 * stress + self.mass[:, None, None] * self.C
        corners = list(np.ndindex((3,) * self.dim))
        for k in corners:
            weight = np.prod([w[k[d], :, d] for d in range(self.dim)], axis=0)
            arm = (np.array(k) - f) * self.dx
            at = tuple((base + k).T)
            np.add.at(m, at, weight * self.mass)
            momentum = self.mass[:, None] * self.v + np.einsum("pij,pj->pi", affine, arm)
            np.add.at(mv, at, weight[:, None] * momentum)
        v = np.where(m[..., None] > 0, mv / np.maximum(m, 1e-300)[..., None] + dt * self.gravity, 0)
        index = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1)
        for d in range(self.dim):
            v[..., d][(index[..., d] < 3) & (v[..., d] < 0)] = 0
            v[..., d][(index[..., d] >= self.res[d] - 3) & (v[..., d] > 0)] = 0
        for act in self.on_nodes:
            act(index * self.dx, v)
        new, C = np.zeros_like(self.v), np.zeros_like(self.C)
        for k in corners:
            weight = np.prod([w[k[d], :, d] for d in range(self.dim)], axis=0)
            u = v[tuple((base + k).T)]
            new += weight[:, None] * u
            C += 4 / self.dx * weight[:, None, None] * u[:, :, None] * (np.array(k) - f)[:, None, :]
        moves = self.material != STATIONARY
        self.v[moves], self.C[moves] = new[moves], C[moves]
        self.x[moves] += dt * self.v[moves]


def block(dim, low=0.3, high=0.5, count=5):
    axis = np.linspace(low, high, count)
    x = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), -1).reshape(-1, dim)
    return x + 0.01 * np.random.default_rng(0).uniform(-1, 1, x.shape)


def frame_of(solver, steps):
    """Length of a frame of a number of substeps [s]."""
    return (steps - 0.5) * solver.default_dt


def advance(solver, own, frame):
    """A frame in both; the number of substeps is that of the solver."""
    before = solver.total_substeps
    solver.step(frame)
    dt = frame / (int(frame / solver.default_dt) + 1)
    for _ in range(solver.total_substeps - before):
        own.step(dt)
    return solver.particle_info()["position"]


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("material", [WATER, ELASTIC, SNOW, SAND])
def test_trajectories(material, dim, device):
    """A block that falls to the floor: within 1e-4 of the domain after some 60 substeps.

    Snow hardens by J_p after the flow of a step, in taichi_elements by that before: shorter steps are closer.
    """
    res = (24,) * dim
    x = block(dim, 0.135, 0.3, 5 if dim == 3 else 8)
    solver = MPMSolver(res, dt_scale=0.3 if material == SNOW else 1.0, device=device)
    velocity = [0.5, -1.0, 0.2][:dim]
    solver.add_particles(x.astype(np.float32), material, velocity=velocity)
    own = Restated(res, x.astype(np.float32).astype(float), material, velocity)
    for _ in range(2):
        found = advance(solver, own, frame_of(solver, 30))
    assert np.abs(found - own.x).max() < 1e-4 and np.abs(own.x - x).max() > 0.01
    dt = frame_of(solver, 30) / 30
    assert solver.t == pytest.approx(solver.total_substeps * dt) and solver.total_substeps in (60, 61, 62)


def test_colliders_and_added_bodies(device):
    """Water on a slope beside a body at rest, and jelly that is added later."""
    solver = MPMSolver((24, 24), water_density=0.8, device=device)
    first, rest, later = block(2, 0.3, 0.45), block(2, 0.14, 0.2, 3), block(2, 0.55, 0.7)
    own = Restated((24, 24), np.concatenate([first, rest]).astype(np.float32).astype(float), WATER, 0.0, 0.8)
    own.material[len(first) :] = STATIONARY
    own.mass[len(first) :] /= 0.8
    own.v[:] = np.where((own.material == WATER)[:, None], [0.0, -2.0], 0.0)
    solver.add_particles(first, solver.material_water, velocity=(0.0, -2.0))
    solver.add_particles(rest, solver.materials["STATIONARY"], color=7)
    normal = np.array([0.6, 0.8])
    solver.add_surface_collider((0.3, 0.22), (1.2, 1.6), MPMSolver.surface_separate, 0.3)
    solver.add_sphere_collider((0.6, 0.3), 0.09, MPMSolver.surface_sticky)

    def slope(x, v):
        behind = (x - [0.3, 0.22]) @ normal < 0
        along = v @ normal
        u = v - np.minimum(along, 0)[..., None] * normal
        size = np.linalg.norm(u, axis=-1)
        slows = (along < 0) & (size > 1e-30)
        factor = np.where(slows, np.maximum(0, size + along * 0.3) / np.maximum(size, 1e-30), 1)
        v[behind] = (u * factor[..., None])[behind]

    def ball(x, v):
        v[((x - [0.6, 0.3]) ** 2).sum(-1) < 0.09**2] = 0

    own.on_nodes += [slope, ball]
    assert np.abs(advance(solver, own, frame_of(solver, 20)) - own.x).max() < 1e-4
    solver.set_gravity((1.0, -5.0))
    own.gravity = np.array([1.0, -5.0])
    solver.add_particles(later, MPMSolver.material_elastic, velocity=(-0.5, 0.0))
    added = Restated((24, 24), later.astype(np.float32).astype(float), ELASTIC, [-0.5, 0.0])
    for name in ("x", "v", "C", "F", "Jp", "mass", "material"):
        setattr(own, name, np.concatenate([getattr(own, name), getattr(added, name)]))
    assert np.abs(advance(solver, own, frame_of(solver, 20)) - own.x).max() < 1e-4
    info = solver.particle_info()
    assert set(info["material"].tolist()) == {WATER, ELASTIC, STATIONARY} and (info["color"] == 7).sum() == 9
    still = info["material"] == STATIONARY
    assert np.array_equal(info["position"][still], rest.astype(np.float32))
    solver.clear_grid_postprocess()
    solver.clear_particles()
    assert solver.n_particles == 0 and solver.particle_info()["position"].shape == (0, 2)
    solver.step(1e-3)


BALL = 4 / 3 * math.pi * 0.2**3
SHAPES = [
    (2, lambda s: s.add_cube((0.2, 0.3), (0.2, 0.1), 1), lambda x: ((x >= 0.2) & (x <= 0.4)).all(1), 0.02),
    (3, lambda s: s.add_cube((0.2,) * 3, (0.2,) * 3, 1, sample_density=4), lambda x: (x <= 0.4).all(1), 0.004),
    (2, lambda s: s.add_ellipsoid((0.5,) * 2, (0.2, 0.1), 1), lambda x: in_ball(x, [0.2, 0.1]), math.pi * 0.02),
    (3, lambda s: s.add_ellipsoid((0.5,) * 3, 0.2, 1), lambda x: in_ball(x, 0.2), BALL),
    (2, lambda s: s.add_ngon(4, (0.5, 0.5), 0.2, 0.0, 1), lambda x: np.abs(x - 0.5).sum(1) <= 0.2001, 0.08),
    (2, lambda s: s.add_texture_2d(0.3, 0.4, np.eye(6), 1), lambda x: x[:, 0] + 0.1 - x[:, 1] < 1e-6, None),
]


def in_ball(x, radii):
    return (((x - 0.5) / radii) ** 2).sum(1) <= 1.0001


@pytest.mark.parametrize(("dim", "add", "inside", "volume"), SHAPES)
def test_sampled_bodies(dim, add, inside, volume):
    """Points are inside, fill the shape, and are as many as cells times the density."""
    torch.manual_seed(0)
    solver = MPMSolver((32,) * dim)
    add(solver)
    x = solver.particle_info()["position"]
    assert inside(x).all()
    density = 4 if dim == 2 or volume == 0.004 else 8
    expected = 6 if volume is None else (0.008 if volume == 0.004 else volume) * 32**dim * density
    assert abs(len(x) - expected) <= 1
    assert np.ptp(x, axis=0).min() > 0.09


def test_a_restart_continues():
    """Positions, velocities, materials and colors as they were."""
    solver, other = MPMSolver((24, 24)), MPMSolver((24, 24), use_emitter_id=True, quant=False)
    solver.add_particles(block(2), ELASTIC, 3, (1.0, 0.0))
    solver.step(1e-3, print_stat=True)
    info = solver.particle_info()
    other.read_restart(len(info["color"]), *(info[k] for k in ("position", "velocity", "material", "color")))
    for name, value in other.particle_info().items():
        assert np.array_equal(value, info.get(name, np.zeros(25)))
    unbounded = MPMSolver((8, 8), unbounded=True)
    unbounded.add_particles(block(2) - 1.0, ELASTIC)
    unbounded.step(1e-3)
    assert unbounded.particle_info()["position"].max() < -0.4


def tetrahedron(size=0.4, low=0.3):
    """Triangles [4, 9] of a corner of a cube."""
    pytest.importorskip("trimesh")
    corners = low + size * np.vstack([np.zeros(3), np.eye(3)])
    return corners[[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]].reshape(4, 9)


@pytest.mark.parametrize("shape", [(4, 9), (4, 3, 3)])
def test_a_mesh_is_filled(shape):
    """8 particles in each cell of a tetrahedron that is moved, all inside, with the mean of its corners."""
    solver = MPMSolver((40,) * 3)
    triangles = torch.tensor(tetrahedron()).reshape(shape)
    torch.manual_seed(3)
    solver.add_mesh(triangles, MPMSolver.material_elastic, 0x123456, velocity=(0, 0, -1.0), translation=(0.1, 0, 0))
    info = solver.particle_info()
    inside = info["position"] - [0.4, 0.3, 0.3]
    assert (inside > -1e-6).all() and (inside.sum(1) < 0.4 + 1e-6).all()
    assert len(inside) == pytest.approx(8 * 0.4**3 / 6 * 40**3, rel=0.03)
    np.testing.assert_allclose(inside.mean(0), 0.1, atol=2e-3)
    assert (info["velocity"] == [0, 0, -1.0]).all() and (info["color"] == 0x123456).all()
    torch.manual_seed(3)
    other = MPMSolver((40,) * 3)
    other.add_mesh(triangles, MPMSolver.material_elastic, translation=[0.1, 0, 0], sample_density=8)
    assert np.array_equal(other.particle_info()["position"], info["position"])


@pytest.mark.parametrize("dim", [2, 3])
def test_files_of_particles(dim, tmp_path):
    """Positions to 24 bits and velocities to 8 bits of their range, and colours, of both formats."""
    solver = MPMSolver((16,) * dim)
    rng = np.random.default_rng(0)
    for color, velocity in ((0xFF8001, 1.0), (0x0000FF, -2.0)):
        solver.add_particles(rng.uniform(0.3, 0.7, (20, dim)), ELASTIC, color, (velocity, *(0.0,) * (dim - 1)))
    info = solver.particle_info()
    solver.write_particles(f"{tmp_path}/00001")
    with np.load(tmp_path / "00001.npz") as data:
        ranges, both, color = data["ranges"], data["x_and_v"], data["color"]
    assert ranges.shape == (2, dim, 2) and ranges.dtype == np.float32 and both.dtype == np.uint32
    low, high = ranges[0].T.astype(np.float64)
    x = low + (both >> 8) / (2**24 - 1) * (high - low)
    np.testing.assert_allclose(x, info["position"], atol=1.1 * (high - low).max() / 2**24)
    low, high = ranges[1].T.astype(np.float64)
    v = low + (both & 255) / 255 * (high - low)
    np.testing.assert_allclose(v, info["velocity"], atol=3.01 / 255)
    assert color.dtype == np.uint8 and color[0].tolist() == [255, 128, 1] and color[-1].tolist() == [0, 0, 255]
    solver.write_particles_ply(tmp_path / "1.ply")
    found = point_files.read(tmp_path / "1.ply", 3)
    np.testing.assert_array_equal(found.x[:, :dim].astype(np.float32), info["position"])
    assert (found.x[:, dim:] == 0).all() and found.fields["blue"][0] == 1 and found.fields["red"][0] == 255
    assert sorted(path.name for path in tmp_path.iterdir()) == ["00001.npz", "1.ply"]


def test_a_file_of_particles_at_one_place(tmp_path):
    """Ranges are not empty, also where float32 has no number within 1e-5."""
    x = np.full((3, 2), [1000.0, 0.5], np.float32)
    particle_io.write_particles(tmp_path / "one.npz", x, 0 * x, np.zeros(3, np.int32))
    with np.load(tmp_path / "one.npz") as data:
        assert (data["ranges"][:, :, 1] > data["ranges"][:, :, 0]).all() and (data["x_and_v"] == 0).all()


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: MPMSolver((8,)), ValueError, "res must have 2 or 3 numbers"),
        (lambda: MPMSolver((8, 8), quality=3), TypeError, "no argument 'quality'"),
        (lambda: MPMSolver((8, 8), use_adaptive_dt=True), NotImplementedError, "use_adaptive_dt"),
        (
            lambda: MPMSolver((8, 8)).add_particles(np.zeros((3, 3)), 1),
            ValueError,
            r"particles must have shape \[P, 2\]",
        ),
        (lambda: MPMSolver((8, 8)).add_particles(np.zeros((3, 2)), 9), ValueError, "material must be one of"),
        (lambda: MPMSolver((8, 8), support_plasticity=False).add_cube((0, 0), (1, 1), 3), ValueError, "snow and sand"),
        (lambda: MPMSolver((8, 8)).add_surface_collider((0, 0), (0, 1), 0, 0.2), ValueError, "friction must be 0"),
        (lambda: MPMSolver((8, 8)).add_surface_collider((0, 0), (0, 1), 5), ValueError, "surface must be one of"),
        (lambda: MPMSolver((8, 8)).add_mesh(None, 1), ValueError, "add_mesh needs a solver of 3 dimensions"),
        (
            lambda: MPMSolver((8,) * 3).add_mesh(np.zeros((4, 6)), 1),
            ValueError,
            r"triangles must have shape \[T, 9\] or \[T, 3, 3\], got",
        ),
        (lambda: MPMSolver((8,) * 3).add_mesh(tetrahedron()[1:], 1), ValueError, "mesh .* is not closed"),
        (lambda: MPMSolver((8, 8)).write_particles("x"), ValueError, "write_particles needs particles"),
        (lambda: MPMSolver((8,) * 3).add_ngon(5, (0, 0), 1, 0, 1), ValueError, "add_ngon needs a solver of 2"),
        (
            lambda: MPMSolver((8, 8)).add_cube((0, 0), (-1, 1), 1),
            ValueError,
            "cube_size must not be negative",
        ),
        (
            lambda: MPMSolver((8, 8)).add_cube((0, 0), (1, 1), 1, sample_density=-1),
            ValueError,
            "sample_density must be",
        ),
        (lambda: MPMSolver((8, 8)).add_cube((0, 0), (1, 1), "water"), TypeError, "material must be a whole number"),
        (lambda: MPMSolver((8, 8)).add_ellipsoid((0, 0), -1.0, 1), ValueError, "radius must be positive"),
        (lambda: MPMSolver((8, 8)).add_ngon(5, (0, 0), -1.0, 0.0, 1), ValueError, "radius must be positive"),
        (lambda: MPMSolver((8, 8), dt_scale=0), ValueError, "dt_scale must be positive"),
        (lambda: MPMSolver((8, 8), E_scale=-1), ValueError, "E_scale must be positive"),
        (lambda: MPMSolver((8, 8)).add_particles([[0.5, 0.5], [0.5, np.nan]], 1), ValueError, "finite, .* particle 1$"),
        (
            lambda: MPMSolver((8, 8)).read_restart(2, np.zeros((2, 2)), np.zeros((1, 2)), [1, 1], [0, 0]),
            ValueError,
            "velocities must have shape",
        ),
        (
            lambda: MPMSolver((8, 8)).set_gravity(torch.zeros(2, requires_grad=True)),
            ValueError,
            "g must be 2 numbers, got a tensor that requires grad",
        ),
        (lambda: MPMSolver((8, 8)).step(0.0), ValueError, "frame_dt must be positive"),
        (lambda: MPMSolver((8, 8)).step(1e9), ValueError, "frame_dt must be at most"),
    ],
)
def test_what_cannot_be_done_is_said(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_options_of_the_storage_are_reported():
    with pytest.warns(UserWarning, match="have no effect: quant, use_g2p2g"):
        MPMSolver((8, 8), quant=True, use_g2p2g=True)


def test_the_number_of_particles_is_a_field():
    solver = MPMSolver((8, 8))
    assert solver.n_particles[None] == solver.n_particles == 0
    solver.add_particles(np.full((3, 2), 0.5), ELASTIC)
    assert solver.n_particles[None] == solver.n_particles == 3 and f"{solver.n_particles}" == "3"
    with pytest.raises(IndexError, match="a field without axes must have the index None, got 0"):
        solver.n_particles[0]


def test_no_particles_are_added_and_tensors_are_vectors():
    solver = MPMSolver((8, 8))
    solver.add_particles(np.zeros((0, 2)), MPMSolver.material_water)
    solver.step(1e-3)
    solver.set_gravity(torch.tensor([0.0, -1.0]))
    solver.add_cube((0.4, 0.4), (0.2, 0.2), MPMSolver.material_elastic, velocity=torch.tensor([0.5, 0.0]))
    solver.step(1e-3)
    velocity = solver.particle_info()["velocity"]
    assert len(velocity) and velocity[:, 0].min() > 0.1 and velocity[:, 1].max() < 0
