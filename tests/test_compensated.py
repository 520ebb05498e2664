"""Motion below half a unit in the last place of the positions: it adds up, in every way of taking steps."""

import pickle

import pytest
import torch
from helpers import relative_error
from pairs import in_pairs

import torch_mpm as mpm
from benchmarks.catalogue.laws import named
from torch_mpm.ops.g2p_advance import g2p_advance_compensated

F32, F64 = torch.float32, torch.float64
STEEL = {"E": 2e11, "nu": 0.3}
DT = 1e-7
"""About a tenth of the stability limit of steel in cells of 1/20 m [s]."""
SPEED = 0.01
"""Speed of the block [m/s]: 1e-9 m per step, where half a unit in the last place of 0.5 is 3e-8 m."""


def block(dim, dtype, offset=0.0, device="cpu", law=None, **options):
    """A step, and a block of steel that moves along all axes, without a force."""
    corner = torch.full((dim,), offset, dtype=F64)
    grid = mpm.Grid(0.05, corner.tolist(), (corner + 1).tolist())
    low, high = ((corner + end).tolist() for end in (0.5, 0.6))
    points = mpm.seed.box(low, high, grid, per_cell=2**dim, device=device)
    v = [SPEED, -SPEED, 0.5 * SPEED][:dim]
    state = mpm.State.at_rest(points, 7850.0, velocity=v, dtype=dtype)
    return mpm.Step(grid, mpm.NeoHookean(**STEEL) if law is None else law, **options), state


def place(state):
    """Where particles are, in float64."""
    return state.x.double() + (0 if state.x_residual is None else state.x_residual)


def moved(state, end):
    return (place(end) - place(state)).cpu()


def repeated(step, state, n, dt):
    for _ in range(n):
        state = step(state, dt)
    return state


WAYS = {
    "steps": lambda step, state: repeated(step, state, 200, DT),
    "rollout": lambda step, state: mpm.rollout(step, state, 200, DT),
    "rollouts": lambda step, state: repeated(lambda s, dt: mpm.rollout(step, s, 20, dt), state, 10, DT),
    "hooks": lambda step, state: mpm.rollout(step, state, 200, DT, hook=lambda s, k: None, every=50),
    "tensor dt": lambda step, state: mpm.rollout(
        step, state, 200, torch.full((), DT, dtype=state.x.dtype, device=state.x.device)
    ),
    "rollout_to": lambda step, state: mpm.rollout_to(step, state, 200 * DT, longest=DT).state,
    "frames": lambda step, state: mpm.frames(step, state, 200, DT, every=50).end,
    "recorded": lambda step, state: mpm.rollout(
        step, state.replace(v=state.v.requires_grad_()), 200, DT, mpm.Checkpoints(memory=1e9)
    ),
    "recomputed": lambda step, state: mpm.rollout(step, state.replace(v=state.v.requires_grad_()), 200, DT, 50),
    "from Python": lambda step, state: mpm.rollout(lambda s, dt: step(s, dt), state, 200, DT),
}


@pytest.mark.parametrize(*in_pairs(offset=[0.0, 500.0], dtype=[F32, F64], way=WAYS, dim=[2, 3]))
def test_slow_steel_moves(way, dtype, offset, dim, device):
    """By v t to 1e-3, and all of its kinetic energy is in that motion."""
    step, state = block(dim, dtype, offset, device)
    end = WAYS[way](step, state)
    expected = state.v.detach().double().cpu() * 200 * DT
    assert (end.x_residual is not None) == (dtype == F32)
    bound = 1e-3 if dtype == F32 else 1e-3 + 1e-13 * offset / (200 * DT * SPEED)
    assert relative_error(moved(state, end), expected) < bound
    energy = [float((s.mass.double()[:, None] * s.v.detach().double() ** 2).sum()) for s in (state, end)]
    assert energy[1] == pytest.approx(energy[0], rel=1e-4)
    assert float((end.x.double() - place(end)).abs().max()) <= 2 * step.grid.rounding(dtype)


@pytest.mark.parametrize(
    *in_pairs(
        options=[{"integrator": "implicit"}, {"flip": 0.9}, {"stress_form": "gradient"}, {"transfer": "pic"}],
        many=[False, True],
        dim=[2, 3],
    )
)
def test_slow_steel_moves_with_all_transfers(options, many, dim, device):
    step, state = block(dim, F32, 0.0, device, **options)
    end = mpm.rollout(step, state, 60, DT) if many else repeated(step, state, 60, DT)
    assert relative_error(moved(state, end), state.v.double().cpu() * 60 * DT) < 1e-3


def test_slow_steel_moves_for_a_hundred_thousand_steps(device):
    """In one call, and in calls that are parts of the motion."""
    step, state = block(2, F32, 0.0, device)
    one = mpm.rollout(step, state, 100_000, DT)
    assert relative_error(moved(state, one), state.v.double().cpu() * 1e5 * DT) < 1e-3
    assert relative_error(one.x.double() - state.x.double(), state.v.double() * 1e5 * DT) < 1e-3


def test_without_compensation_it_does_not_move_and_that_is_reported(device):
    step, state = block(2, F32, 0.0, device, compensated=False)
    with pytest.warns(
        mpm.PrecisionWarning, match=r"float32 changes the motion in steps of dt = 1e-07 s.*compensated=True"
    ):
        end = mpm.rollout(step, state, 200, DT)
    assert torch.equal(end.x, state.x) and end.x_residual is None


# ---- residuals stay with their particles


LAWS = named("neo_hookean", "fluid", "sand", "mixture")


@pytest.mark.parametrize("scenes", [1, 3])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("count", [3000, 2**18 + 64])
def test_residuals_stay_with_their_particles(count, law, scenes, dim, device):
    """At rest they do not change, wherever rollouts put particles in memory meanwhile, and in sorted states."""
    if count > 3000 and (device == "cpu" or law != "neo_hookean" or scenes > 1):
        pytest.skip("of calls that own their particles on CUDA")
    generator = torch.Generator().manual_seed(1)
    grid = mpm.Grid(1 / 32, (0.0,) * dim, (1.0,) * dim, scenes=scenes)
    x = (0.2 + 0.6 * torch.rand(count, dim, generator=generator)).to(device)
    residual = 1e-8 * (torch.rand(count, dim, generator=generator) - 0.5).to(device)
    state = mpm.State(
        x=x,
        v=torch.zeros_like(x),
        mass=torch.ones(count, device=device),
        volume=torch.full((count,), 1e-3, device=device),
        scene=None if scenes == 1 else (torch.arange(count, device=device) % scenes).int(),
        material=(torch.arange(count, device=device) % 2).int() if law == "mixture" else None,
        x_residual=residual,
    )
    step = mpm.Step(grid, LAWS[law]())
    for end in (mpm.rollout(step, state, 80, 1e-4), step(state.sorted(grid), 1e-4).restored()):
        assert torch.equal(end.x, x)
        assert torch.equal(end.x_residual, residual)


def test_the_op_is_exact(dim, device):
    """x + residual moves by dt v, to the rounding of the residual; outside the grid it stays."""
    step, state = block(dim, F32, 0.0, device)
    state = state.replace(x=torch.cat([state.x[:-1], torch.full_like(state.x[:1], 9.0)]))
    blocks = step.grid.activate(state.x)
    velocity = torch.randn(blocks.block.numel() * 4**dim, dim, device=device)
    residual = 1e-8 * torch.randn_like(state.x)
    x, v, _, _, _, rest = g2p_advance_compensated(blocks, state.x, residual, velocity, 1e-6)
    expected = state.x.double() + residual + 1e-6 * v.double()
    torch.testing.assert_close(x.double() + rest, expected, rtol=0, atol=1e-13)
    assert torch.equal(x[:-1], expected[:-1].float()) and torch.equal(rest[-1], residual[-1])
    plain = mpm.g2p_advance(blocks, state.x, velocity, 1e-6)
    assert torch.equal(plain[1], v) and len(plain) == 5


def test_paused_scenes_keep_their_residual(dim):
    grid = mpm.Grid(0.1, (0.0,) * dim, (1.0,) * dim, scenes=2)
    points = mpm.seed.box((0.4,) * dim, (0.6,) * dim, 0.1, 2**dim)
    one = mpm.State.at_rest(points, 7850.0, velocity=(SPEED,) * dim)
    state = mpm.State.concatenate([one, one.replace(x_residual=torch.full_like(one.x, 1e-8))], scene=True)
    assert not state.x_residual[: len(one)].any()
    dt = torch.tensor([DT, 0.0])
    step = mpm.Step(grid, mpm.NeoHookean(**STEEL))
    for end in (step(state, dt), mpm.rollout(step, state, 3, dt)):
        assert bool((end.x_residual[: len(one)] > 0).all())
        assert torch.equal(end.x_residual[len(one) :], state.x_residual[len(one) :])


# ---- gradients


@pytest.mark.parametrize("way", ["rollout", "checkpoint", "memory", "steps"])
@pytest.mark.parametrize("law", ["neo_hookean", "fluid", "sand"])
def test_gradients_are_those_without_compensation(way, law, dim, device):
    """To rounding in float64, for recorded and for recomputed steps."""
    n, kept = 12, {"checkpoint": 4, "memory": mpm.Checkpoints(memory=1e9)}.get(way)

    def gradient(compensated):
        step, state = block(dim, F64, 0.0, device, LAWS[law](), compensated=compensated)
        x, v = state.x.clone().requires_grad_(), (100 * state.v).requires_grad_()
        state = state.replace(x=x, v=v)
        end = repeated(step, state, n, 1e-4) if way == "steps" else mpm.rollout(step, state, n, 1e-4, kept)
        assert (end.x_residual is not None) == bool(compensated)
        assert end.x_residual is None or not end.x_residual.requires_grad
        return torch.autograd.grad((end.x.square() + end.v).sum(), (x, v))

    for mine, other in zip(gradient(True), gradient(None), strict=True):
        assert relative_error(mine, other) < 1e-10


# ---- float32 beside float64


@pytest.mark.parametrize("offset", [0.0, 100.0, 700.0])
def test_a_ball_falls_in_float32_as_in_float64(offset, dim, device):
    """Far from zero, where each of its steps is a few units in the last place."""

    def fallen(dtype, **options):
        corner = torch.full((dim,), offset, dtype=F64)
        grid = mpm.Grid(0.05, corner.tolist(), (corner + 2).tolist())
        points = mpm.seed.sphere((corner + 1.2).tolist(), 0.2, grid, per_cell=2**dim, device=device)
        state = mpm.State.at_rest(points, 1000.0, dtype=dtype)
        step = mpm.Step(grid, mpm.NeoHookean(E=1e5, nu=0.3), gravity=(0, -9.8, 0)[:dim], **options)
        return moved(state, mpm.rollout(step, state, 400, 2.5e-4))[:, 1].mean()

    expected = fallen(F64)
    assert float(expected) == pytest.approx(-0.5 * 9.8 * 0.1**2, rel=5e-3)
    assert float(fallen(F32)) == pytest.approx(float(expected), rel=1e-4)


# ---- when


@pytest.mark.parametrize(
    ("dtype", "reach", "dt", "needed"),
    [
        (F32, 1.0, 1e-3, False),
        (F32, 1.0, 1e-5, True),
        (F32, 500.0, 1e-3, True),
        (F64, 1.0, 1e-7, False),
        (F32, 1e-3, 1e-7, True),
    ],
)
def test_positions_are_compensated_where_steps_need_it(dtype, reach, dt, needed, dim):
    grid = mpm.Grid(reach / 20, (0.0,) * dim, (reach,) * dim)
    state = mpm.State.at_rest(mpm.seed.box((0.4 * reach,) * dim, (0.6 * reach,) * dim, grid, 2**dim), dtype=dtype)
    step = mpm.Step(grid, mpm.NeoHookean(E=1e3, nu=0.3))
    for given in (dt, torch.tensor(dt, dtype=dtype), torch.tensor([dt], dtype=dtype)):
        assert (step(state, given).x_residual is not None) == needed
    assert mpm.Step(grid, step.law, compensated=True)(state, dt).x_residual is not None
    kept = step(state.replace(x_residual=torch.zeros_like(state.x)), 1.0)
    assert kept.x_residual is not None, "a state that has one keeps it"
    with pytest.raises(TypeError, match="compensated must be True or False"):
        mpm.Step(grid, step.law, compensated="yes")


# ---- states


def test_states_with_residuals(dim, tmp_path):
    """Selected, joined, cast, copied and read from files."""
    step, state = block(dim, F32)
    state = step(state, DT)
    residual = state.x_residual
    few = torch.arange(5, 0, -1)
    assert torch.equal(state.select(few).x_residual, residual[few])
    wide = state.to(dtype=F64)
    assert wide.x_residual is None and torch.equal(wide.x, state.x.double() + residual)
    narrow = wide.replace(x_residual=torch.zeros_like(wide.x)).to(dtype=F32)
    assert torch.equal(narrow.x, state.x)
    torch.testing.assert_close(narrow.x_residual, residual, rtol=1e-5, atol=1e-16)
    loaded = pickle.loads(pickle.dumps(state))
    assert torch.equal(loaded.x_residual, residual)
    earlier = {name: value for name, value in state.__getstate__().items() if name != "x_residual"}
    loaded.__setstate__(earlier)
    assert loaded.replace(v=state.v).x_residual is None
    with pytest.raises(ValueError, match=r"x_residual must have shape \[P, D\]"):
        state.replace(x_residual=residual[:3])


def test_environments_reset_scenes_with_residuals(dim):
    step, one = block(dim, F32)
    grid = mpm.Grid(0.05, step.grid.lower, step.grid.upper, scenes=2)
    envs = mpm.Environments(mpm.Step(grid, step.law), [one, one])
    envs.advance(5, DT)
    assert envs.state.x_residual is not None
    envs.reset([1], [one])
    assert torch.equal(envs.scene(1).x, one.x) and not envs.scene(1).x_residual.any()
    envs.advance(5, DT)
    assert relative_error(moved(one, envs.scene(1)), one.v.double() * 5 * DT) < 1e-3
    assert relative_error(moved(one, envs.scene(0)), one.v.double() * 10 * DT) < 1e-3


def test_a_scene_file_of_slow_steel_moves(tmp_path):
    """In a run that is resumed from a checkpoint too, whose states have the residuals."""
    pytest.importorskip("pydantic")
    pytest.importorskip("h5py")
    from torch_mpm.scene import Scene
    from torch_mpm.state.state import tensors_of
    from torch_mpm.state.state_file import load, save

    scene = Scene(
        grid={"lower": (0, 0), "upper": (1, 1), "dx": 0.05},
        duration=4e-4,
        fps=5e3,
        device="cpu",
        material={"steel": {"law": "neo_hookean", "density": 7850, **STEEL}},
        body=[{"shape": "box", "lower": (0.5, 0.5), "upper": (0.7, 0.7), "velocity": (SPEED, 0), "material": "steel"}],
    )
    scene.run(tmp_path / "out")
    with mpm.Trajectory(tmp_path / "out") as read:
        x, speed = read["position"].astype(float), read["velocity"][-1, :, 0]
    assert (speed > 0.9 * SPEED).all()
    assert (x[-1] - x[0])[:, 0].mean() == pytest.approx(SPEED * 4e-4, rel=0.01)  # rounding: 3e-8 m
    built = scene.build()
    state = mpm.rollout(built.step, built.state, 3, DT)
    save(tmp_path / "state.h5", tensors_of(state), {"time": float(state.time)})
    assert torch.equal(load(tmp_path / "state.h5")[0].x_residual, state.x_residual)
