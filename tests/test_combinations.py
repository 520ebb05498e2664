"""Properties of every simulation, on random combinations of all options (`combinations.draw`).

`COMBINATIONS=2000 pytest tests/test_combinations.py` runs more of them than the quick suite; a failing test names the
seed that makes its combination again.
"""

import math
import os
from collections.abc import Callable

import pytest
import torch
from combinations import DT, PLASTIC, WITH_ENERGY, Combination, draw, make
from torch import Tensor

import torch_mpm as mpm

COUNT = int(os.environ.get("COMBINATIONS", "60"))
FIELDS = ("x", "v", "C", "F", "J", "temperature")
DIFFERENTIABLE = ("x", "v", "C", "F", "J", "mass", "volume", "temperature")

DRAWN = [draw(seed) for seed in range(COUNT)]


def every(holds: Callable[[Combination], bool] = lambda c: True) -> pytest.MarkDecorator:
    """The combinations for which something holds; the last of them are thorough."""
    those = [c for c in DRAWN if holds(c)]
    quick = len(those) if "COMBINATIONS" in os.environ else math.ceil(0.6 * len(those))
    cases = [pytest.param(c, marks=() if k < quick else pytest.mark.thorough) for k, c in enumerate(those)]
    return pytest.mark.parametrize("c", cases, ids=lambda c: f"{c.seed}-{c.law}")


def fields_of(state: mpm.State) -> dict[str, Tensor]:
    fields = {name: value for name in FIELDS if (value := getattr(state, name)) is not None}
    return fields | state.extra


def roll(step: mpm.Step, state: mpm.State, n: int) -> mpm.State:
    for _ in range(n):
        state = step(state, DT)
    return state


def assert_same(a: mpm.State, b: mpm.State, tolerance: float, text: str) -> None:
    """Fields agree to a tolerance relative to their largest value."""
    left, right = fields_of(a), fields_of(b)
    assert left.keys() == right.keys()
    for name, value in left.items():
        scale = float(right[name].abs().max().clamp_min(1e-6))
        assert bool(value.isfinite().all()), f"{name}: {text}"
        error = float((value - right[name]).abs().max()) / scale
        assert error < tolerance, f"{name} differs by {error:.2g}: {text}"


def loss_of(c: Combination, state: mpm.State) -> Tensor:
    g = torch.Generator().manual_seed(5)
    total = state.x.new_zeros(())
    for value in fields_of(state).values():
        weight = torch.randn(value.shape, generator=g, dtype=value.dtype).to(value.device)
        total = total + (weight * value).sum()
    return total


def directions(state: mpm.State) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(6)
    result = {}
    for name in DIFFERENTIABLE:
        value = getattr(state, name)
        if value is not None:
            result[name] = value.detach().abs().mean().cpu() * torch.randn(value.shape, generator=g, dtype=value.dtype)
            result[name] = result[name].to(value.device)
    return result


@every()
def test_gradients_of_a_rollout_equal_differences(c, device):
    case = make(c, device)
    along = directions(case.state)
    leaves = {name: getattr(case.state, name).detach().clone().requires_grad_() for name in along}

    def loss(values: dict[str, Tensor], checkpoint: int | None) -> Tensor:
        state = case.state.replace(**values)
        return loss_of(c, mpm.rollout(case.step, state, 3, DT, checkpoint=checkpoint))

    grads = torch.autograd.grad(loss(leaves, None), list(leaves.values()))
    slopes = [float((g * along[name]).sum()) for name, g in zip(leaves, grads, strict=True)]
    slope, scale = sum(slopes), max(sum(map(abs, slopes)), 1e-3)
    again = torch.autograd.grad(loss(leaves, c.checkpoint or 2), list(leaves.values()))
    noise = 1e-6 if device == "cuda" and c.contrast > 1e3 else 1e-9  # sums in another order, through such a solve
    for name, a, b in zip(leaves, grads, again, strict=True):
        torch.testing.assert_close(a, b, rtol=noise, atol=noise * float(a.abs().max()), msg=f"{name}: {c.text}")
    errors = []
    with torch.no_grad():
        for h in (1e-5, 1e-6, 1e-7):
            ends = [loss({n: v + s * h * along[n] for n, v in leaves.items()}, None) for s in (1, -1)]
            errors.append(abs(float(ends[0] - ends[1]) / (2 * h) - slope) / scale)
    # A solve to 1e-13 of its first residual leaves more noise in the differences where its condition is 1e4.
    assert min(errors) < (1e-4 if c.contrast > 1e3 else 1e-5), f"{errors}: {c.text}"


@every(lambda c: c.scenes > 1)
def test_a_scene_of_a_batch_moves_as_it_does_alone(c, device):
    batch = make(c, device)
    together = roll(batch.step, batch.state, 3)
    assert together.scene is not None
    for b in range(c.scenes):
        alone = make(c, device, scene=b)
        rows = (together.scene == b).nonzero()[:, 0]
        assert_same(together.select(rows), roll(alone.step, alone.state, 3), 1e-10, c.text)


@every(lambda c: c.scenes > 1)
def test_a_paused_scene_stays_and_the_others_move(c, device):
    """Scene 1 has dt = 0: bit by bit the same, gradients pass through it, and the others do what they do alone."""
    case = make(c, device)
    dt = torch.tensor([DT, 0.0, DT], dtype=case.state.x.dtype, device=device)
    x = case.state.x.detach().clone().requires_grad_()
    moved = mpm.rollout(case.step, case.state.replace(x=x), 3, dt)
    assert moved.scene is not None
    still = (moved.scene == 1).nonzero()[:, 0]
    before, after = fields_of(case.state.select(still)), fields_of(moved.select(still))
    for name, value in before.items():
        assert torch.equal(after[name], value), f"{name}: {c.text}"
    (grad,) = torch.autograd.grad(moved.x.sum() + moved.v.sum(), x)
    assert bool(grad.isfinite().all()) and torch.equal(grad[still], torch.ones_like(grad[still])), c.text
    for b in (0, 2):
        alone = make(c, device, scene=b)
        rows = (moved.scene == b).nonzero()[:, 0]
        assert_same(moved.detach().select(rows), roll(alone.step, alone.state, 3), 1e-10, c.text)
    case.step.check()


@every()
def test_the_order_of_the_particles_does_not_matter(c, device):
    case = make(c, device)
    plain = roll(case.step, case.state, 3)
    ordered = roll(case.step, case.state.sorted(case.step.grid), 3).restored()
    assert_same(ordered.replace(ids=None), plain, 1e-10, c.text)


@every()
def test_exchanged_axes_give_the_exchanged_result(c, device):
    case, swapped = make(c, device), make(c, device, swap=True)
    axes = [1, 0, 2][: c.dim]
    plain, turned = roll(case.step, case.state, 3), roll(swapped.step, swapped.state, 3)
    back = {"x": turned.x[:, axes], "v": turned.v[:, axes]}
    back |= {n: t[:, axes][:, :, axes] for n in ("C", "F") if (t := getattr(turned, n)) is not None}
    extra = {n: t[:, axes] if t.dim() > 1 else t for n, t in turned.extra.items()}
    extra = {n: t[:, :, axes] if t.dim() > 2 else t for n, t in extra.items()}
    assert_same(turned.replace(**back, extra=extra), plain, 1e-9, c.text)


@every()
def test_the_law_leaves_what_it_made(c, device):
    """A second update of the deformation that a law returned changes nothing and dissipates nothing."""
    case = make(c, device)
    law, state = case.step.law, case.state
    for part in law.modules():
        if isinstance(part, mpm.Material):
            part.dissipation = True
    first, stress = law.update(state)
    once = {k: v for k, v in first.items() if k in ("F", "J")}
    history = {k: v for k, v in first.items() if k in law.extra_fields}
    second, again = law.update(state.replace(**once, extra={**state.extra, **history}))
    scale = float(stress.abs().max())
    assert float((again - stress).abs().max()) < 1e-9 * scale, c.text
    for name, value in {**once, **history}.items():
        assert float((second[name] - value).abs().max()) < 1e-10, f"{name}: {c.text}"
    if "dissipated" in second:
        assert float(second["dissipated"].abs().max()) < 1e-9 * scale, c.text


@every(lambda c: c.walls is None and c.obstacle is None)
def test_momentum_grows_by_gravity_alone(c, device):
    case = make(c, device)
    mass = case.state.mass[:, None]
    before, n = (mass * case.state.v).sum(0), 5
    gravity = torch.tensor(case.step.gravity or [0.0] * c.dim, dtype=mass.dtype, device=mass.device)
    after = (mass * roll(case.step, case.state, n).v).sum(0)
    expected = before + n * DT * gravity * mass.sum()
    assert float((after - expected).abs().max()) < 1e-12 * float((mass * case.state.v.abs()).sum()), c.text


def mechanical_energy(step: mpm.Step, state: mpm.State) -> float:
    return float(0.5 * (state.mass * state.v.square().sum(1)).sum() + step.law.energy(state).sum())


@every(lambda c: c.isolated and c.law in WITH_ENERGY)
def test_energy_of_an_isolated_body_does_not_grow(c, device):
    case = make(c, device)
    state = case.state.replace(extra=dict(case.state.extra))
    start = mechanical_energy(case.step, state)
    for _ in range(10):
        state = roll(case.step, state, 10)
        assert mechanical_energy(case.step, state) < 1.05 * start, c.text


@every(lambda c: c.heat is not None and c.law != "melting")
def test_heat_is_conserved_and_jumps_of_the_material_do_not_amplify_it(c, device):
    """The temperature of particles at rest does not rise above its start, for any contrast, in hundreds of steps."""
    case = make(c, device)
    heat, state = case.step.heat, case.state
    assert heat is not None and state.temperature is not None
    before, largest = heat.heat_content(state), float(state.temperature.abs().max())
    for _ in range(100):
        state = heat(state, DT)
    drift = float((heat.heat_content(state) - before).sum().abs()) / float(before.abs().sum())
    assert drift < 1e-10, f"heat drifts by {drift:.2g}: {c.text}"
    peak = float(state.temperature.abs().max())
    assert peak < 2 * largest, f"temperature grew from {largest:.3g} to {peak:.3g}: {c.text}"
    heat.check()


@every(lambda c: c.law in PLASTIC and c.heat is not None and c.isolated)
def test_plastic_heat_is_not_more_than_the_mechanical_energy_lost(c, device):
    case = make(c, device)
    heat, state = case.step.heat, case.state
    assert heat is not None
    mechanical, content = mechanical_energy(case.step, state), float(heat.heat_content(state).sum())
    final = roll(case.step, state, 60)
    gained = (float(heat.heat_content(final).sum()) - content) / heat.plastic_heating
    lost = mechanical - mechanical_energy(case.step, final)
    assert -1e-9 * mechanical <= gained <= lost + 0.02 * mechanical, f"{gained} of {lost}: {c.text}"


@every(lambda c: c.scenes == 1 and c.heat is not None and c.law != "melting")
def test_states_joined_after_sorting_are_states_joined_before(c, device):
    """Per-particle parameters of the joined state go to the same particles."""
    case = make(c, device)
    P = len(case.state)
    heat = case.step.heat
    assert heat is not None
    both = mpm.Heat(
        heat.grid, conductivity=torch.cat([heat.conductivity, 3 * heat.conductivity]),
        specific_heat=torch.cat([heat.specific_heat, heat.specific_heat]), transfer=c.heat, tolerance=1e-13,
    )  # fmt: skip
    sorted_one = case.state.sorted(case.step.grid)
    plain = both(mpm.State.concatenate([case.state, case.state]), DT)
    joined = both(mpm.State.concatenate([sorted_one, sorted_one]), DT).restored()
    assert len(joined) == 2 * P
    assert_same(joined.replace(ids=None), plain, 1e-9, c.text)
