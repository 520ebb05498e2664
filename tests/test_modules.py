"""Steps, laws and boundaries as modules of PyTorch: parameters, moves, hooks, and functions in their places."""

import copy

import pytest
import torch
from torch import Tensor, nn

import torch_mpm as mpm
from benchmarks.catalogue import scenes
from torch_mpm import heat_boundaries


def block(device: str = "cpu", dtype: torch.dtype = torch.float64) -> tuple[mpm.Grid, mpm.State]:
    return scenes.unit_box(2, 0.1), scenes.block((0.3, 0.2), (0.6, 0.5), 0.1, 1000.0, (1.0, -2.0), dtype, device)


class Wind(nn.Module):
    """A boundary that is a module, in the way of the docstring of `torch_mpm.boundaries`."""

    def __init__(self, acceleration: Tensor) -> None:
        super().__init__()
        self.acceleration = nn.Parameter(acceleration)

    def forward(self, velocity, positions, scene, time, dt):
        return velocity + dt * self.acceleration


class Old(nn.Module):
    """A module with `apply` in the sense of boundaries."""

    def __init__(self) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(0.5, dtype=torch.float64))

    def apply(self, velocity, positions, scene, time, dt):
        return self.factor * velocity


class Plain:
    def apply(self, velocity, positions, scene, time, dt):
        return 0.5 * velocity


def floor(**options: object) -> mpm.Plane:
    return mpm.Plane((0.0, 0.25), (0.0, 1.0), **options)


def full_step(grid: mpm.Grid, device: str) -> mpm.Step:
    friction = nn.Parameter(torch.tensor(0.4, dtype=torch.float64, device=device))
    position = torch.tensor([0.0, 0.22], dtype=torch.float64, device=device)
    plane = mpm.Plane(position, (0.0, 1.0), friction=friction)
    network = nn.Linear(2, 2).to(device, torch.float64)
    return mpm.Step(
        grid,
        mpm.NeoHookean(E=1e4, nu=0.3),
        gravity=torch.tensor([0.0, -9.8], dtype=torch.float64, device=device),
        boundaries=[plane, Wind(torch.ones(2, dtype=torch.float64, device=device)), Plain(), Old().to(device)],
        on_grid=lambda_module(network),
    )


def lambda_module(network: nn.Module) -> nn.Module:
    class Control(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network = network

        def forward(self, blocks, velocity, mass, dt):
            return velocity + dt * self.network(velocity) * (mass[:, None] > 0)

    return Control()


def test_a_step_has_the_parameters_of_its_parts(device):
    """Found, trained, moved, saved and loaded like those of any module."""
    grid, state = block(device)
    step = full_step(grid, device)
    names = {name for name, _ in step.named_parameters()}
    expected = {"boundaries.0.friction", "boundaries.1.acceleration", "boundaries.3.factor"}
    assert names == expected | {"on_grid.network.weight", "on_grid.network.bias"}
    assert {name for name, _ in step.named_buffers()} == {"gravity", "boundaries.0.position"}
    mpm.rollout(step, state, 2, 1e-3).x.sum().backward()
    assert all(p.grad is not None and float(p.grad.abs().max()) > 0 for p in step.parameters())
    step.zero_grad()
    values = copy.deepcopy(step.state_dict())
    other = full_step(grid, device)
    with torch.no_grad():
        for p in other.parameters():
            p.fill_(0.1)
    other.load_state_dict(values)
    a, b = (mpm.rollout(s, state, 3, 1e-3) for s in (step, other))
    assert torch.equal(a.v, b.v)
    single = copy.deepcopy(step).to(torch.float32)
    assert {t.dtype for t in (*single.parameters(), *single.buffers())} == {torch.float32}
    end = mpm.rollout(single, state.to(dtype=torch.float32), 3, 1e-3)
    torch.testing.assert_close(end.v.double(), a.v, rtol=1e-3, atol=1e-4)


def test_module_apply_reaches_all_parts():
    step = full_step(block()[0], "cpu")
    seen: list[nn.Module] = []
    step.apply(seen.append)
    assert len(seen) == len(set(map(id, seen))) == len(list(step.modules()))


def test_the_list_of_boundaries_is_a_list(device):
    grid, state = block(device)
    step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3))
    assert not step.boundaries and not list(step.parameters())
    plane, wind = floor(), Wind(torch.zeros(2, dtype=torch.float64, device=device))
    step.boundaries.append(plane)
    step.boundaries.insert(0, wind)
    assert list(step.boundaries) == [wind, plane] and step.boundaries[1] is plane
    assert [name for name, _ in step.named_parameters()] == ["boundaries.0.acceleration"]
    stopped = step(state, 1e-3)
    step.boundaries = [plane]
    assert list(step.parameters()) == []
    torch.testing.assert_close(step(state, 1e-3).v, stopped.v)
    del step.boundaries[0]
    free = step(state, 1e-3)
    assert not torch.allclose(free.v, stopped.v)
    step.boundaries += [plane]
    torch.testing.assert_close(step(state, 1e-3).v, stopped.v)


def test_numbers_and_tensors_of_obstacles_may_be_exchanged(device):
    ball = mpm.Sphere((0.0, 0.0), 0.5, velocity=(1.0, 0.0))
    ball.velocity = torch.tensor([3.0, 0.0], dtype=torch.float64, device=device)
    assert [name for name, _ in ball.named_buffers()] == ["velocity"]
    ball.velocity = nn.Parameter(ball.velocity)
    assert [name for name, _ in ball.named_parameters()] == ["velocity"] and not list(ball.buffers())
    ball.position = nn.Identity()
    ball.position, ball.velocity = (0.0, 0.0), (2.0, 0.0)
    assert not list(ball.parameters()) and list(ball.children()) == [ball.shape]
    zero = torch.zeros(1, 2, dtype=torch.float64, device=device)
    assert ball(zero, zero, None, 0.0, 1e-3).tolist() == ball.apply(zero, zero, None, 0.0, 1e-3).tolist()


def test_a_function_of_time_with_parameters(device):
    class Path(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.speed = nn.Parameter(torch.tensor([0.0, 0.5], dtype=torch.float64, device=device))

        def forward(self, time: Tensor) -> Tensor:
            return time[..., None] * self.speed + torch.tensor([0.4, 0.1], dtype=torch.float64, device=device)

    grid, state = block(device)
    step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), boundaries=[mpm.Sphere(Path(), 0.2, "sticky")])
    mpm.rollout(step, state, 3, 1e-3).v.sum().backward()
    (speed,) = step.parameters()
    assert float(speed.grad[1]) > 0


def test_parameters_of_heat(device):
    """Parameters of its boundaries, of their surfaces and of the obstacles in them."""
    grid, state = block(device)
    where = {"dtype": torch.float64, "device": device}
    flux = nn.Parameter(torch.tensor(1e4, **where))
    held = mpm.Plane((0.0, 0.25), (0.0, 1.0), rotation=torch.tensor(0.1, **where))
    points = torch.tensor([[0.45, 0.45]], **where)
    terms = [
        heat_boundaries.Flux(heat_boundaries.FreeSurface(), flux),
        heat_boundaries.Fixed(held, nn.Parameter(torch.tensor(30.0, **where))),
        heat_boundaries.Convection(
            heat_boundaries.Surface(points, 0.1), 5.0, nn.Parameter(torch.tensor(10.0, **where))
        ),
    ]
    step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), heat=mpm.Heat(grid, 100.0, 1.0, terms))
    heated = step(state.replace(temperature=torch.zeros_like(state.mass)), 1e-3)
    heated.temperature.sum().backward()
    grads = {name: float(p.grad) for name, p in step.named_parameters()}
    assert grads.keys() == {f"heat.boundaries.{k}" for k in ("0.flux", "1.temperature", "2.ambient")}
    assert min(grads.values()) > 0
    assert {name for name, _ in step.heat.named_buffers()} == {
        "boundaries.1.region.rotation",
        "boundaries.2.surface.points",
    }
    seen: list[nn.Module] = []
    step.apply(seen.append)
    assert len(seen) == len(list(step.modules()))
    step.heat.boundaries = []
    assert not list(step.parameters())


# ---- hooks


@pytest.mark.filterwarnings("ignore:Full backward hook is firing")
@pytest.mark.parametrize("mixed", [False, True])
def test_hooks_of_laws_fire(device, mixed):
    """Forward hooks see and replace the stress; full backward hooks get its gradient."""
    grid, state = block(device)
    law = mpm.NeoHookean(E=1e4, nu=0.3)
    step = mpm.Step(grid, mpm.Mixture([law]) if mixed else law)
    state = state.replace(material=torch.zeros(len(state), dtype=torch.int32, device=device)) if mixed else state
    state = state.replace(F=1.1 * step.prepare(state).F.requires_grad_())
    plain = step(state, 1e-3)
    grads: list[Tensor] = []
    backward = law.register_full_backward_hook(lambda module, into, out: grads.append(out[1]))
    step(state, 1e-3).v.square().sum().backward()
    assert grads[0].shape == state.F.shape and float(grads[0].abs().max()) > 0
    backward.remove()
    hook = law.register_forward_hook(lambda module, inputs, output: (output[0], 2 * output[1]))
    doubled = step(state, 1e-3)
    hook.remove()
    law.E = 2e4
    torch.testing.assert_close(doubled.v, step(state, 1e-3).v)
    assert not torch.allclose(doubled.v, plain.v)


def test_hooks_of_obstacles_fire(device):
    grid, state = block(device)
    plane = floor(kind="sticky")
    step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), boundaries=[plane])
    before = step(state, 1e-3)
    plane.register_forward_hook(lambda module, inputs, output: inputs[0])  # undoes the contact
    after = step(state, 1e-3)
    step.boundaries = []
    torch.testing.assert_close(after.v, step(state, 1e-3).v)
    assert not torch.allclose(after.v, before.v)


def test_hooks_of_steps():
    grid, state = block()
    step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3))
    seen = []
    step.register_forward_hook(lambda module, inputs, output: seen.append(output.time))
    mpm.rollout(step, state, 3, 1e-3)
    assert seen == pytest.approx([1e-3, 2e-3, 3e-3])
    for register in (step.register_full_backward_hook, step.register_full_backward_pre_hook):
        with pytest.raises(NotImplementedError, match=r"step\.law\.register_full_backward_hook"):
            register(print)


# ---- functions as laws


def stretch_stress(F: Tensor) -> Tensor:
    return 1e4 * (F @ F.mT - torch.eye(2, dtype=F.dtype, device=F.device))


class StressModule(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.modulus = nn.Parameter(torch.tensor(1e4, dtype=torch.float64))

    def forward(self, F: Tensor) -> Tensor:
        return self.modulus * stretch_stress(F) / 1e4


def test_functions_and_modules_as_laws(device):
    grid, state = block(device)
    expected = mpm.rollout(mpm.Step(grid, mpm.CustomLaw(stretch_stress)), state, 3, 1e-3)
    module = StressModule().to(device)
    for law in (stretch_stress, lambda F: stretch_stress(F), module):
        step = mpm.Step(grid, law)
        assert torch.equal(mpm.rollout(step, state, 3, 1e-3).v, expected.v)
    assert list(step.parameters()) == [module.modulus]
    step.law = mpm.NeoHookean(E=1.0, nu=0.0)
    step.law = stretch_stress
    assert torch.equal(mpm.rollout(step, state, 3, 1e-3).v, expected.v)
    material = torch.zeros(len(state), dtype=torch.int32, device=device)
    mixed = mpm.Step(grid, mpm.Mixture([module, mpm.NeoHookean(E=1.0, nu=0.0)]))
    torch.testing.assert_close(mpm.rollout(mixed, state.replace(material=material), 3, 1e-3).v, expected.v)


def test_a_law_that_is_assigned_gets_the_time_step(device):
    """A viscoplastic law flows in the step also where it replaced an elastic one."""
    grid, state = block(device)
    fluid = mpm.HerschelBulkley(E=1e5, nu=0.3, yield_stress=1.0, consistency=1.0)
    stretches = torch.tensor([1.2, 1 / 1.2], dtype=torch.float64, device=device)
    state = state.replace(F=torch.diag(stretches).repeat(len(state), 1, 1))
    expected = mpm.Step(grid, fluid)(state, 1e-3)
    step = mpm.Step(grid, mpm.NeoHookean(E=1e5, nu=0.3))
    step.law = fluid
    torch.testing.assert_close(step(state, 1e-3).F, expected.F, rtol=1e-12, atol=1e-12)


# ---- gravity


def test_gravity_of_any_form(device):
    """Numbers and tensors of another dtype act alike; assignments take effect; a tensor gets its gradient."""
    grid, state = block(device, torch.float32)
    law = mpm.NeoHookean(E=1e4, nu=0.3)
    expected = mpm.Step(grid, law, gravity=(0.0, -9.5))(state, 1e-3)
    tensor = torch.tensor([0.0, -9.5], dtype=torch.float64, device=device)
    step = mpm.Step(grid, law, gravity=tensor)
    assert torch.equal(step(state, 1e-3).v, expected.v)
    assert step.state_dict().keys() == {"gravity"}
    leaf = tensor.clone().requires_grad_()
    for value in (leaf, nn.Parameter(tensor)):
        step.gravity = value
        grad = torch.autograd.grad(step(state, 1e-3).v.sum(0)[1], value)[0]
        torch.testing.assert_close(grad, torch.tensor([0, 1e-3 * len(state)], dtype=torch.float64, device=device))
    step.gravity = (0, -9.5)
    assert step.gravity == (0.0, -9.5) and not list(step.parameters()) and not list(step.buffers())
    assert torch.equal(step(state, 1e-3).v, expected.v)
    step.gravity = None
    assert not torch.equal(step(state, 1e-3).v, expected.v)
    step.gravity = torch.tensor([0.0, -9.5], device="meta")
    with pytest.raises(ValueError, match="gravity must be on the device of x"):
        step(state, 1e-3)
