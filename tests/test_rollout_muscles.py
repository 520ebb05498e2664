"""Muscles in rollouts in one op against single steps: beside every law of F, in mixtures, with everything else."""

from collections.abc import Callable

import pytest
import torch
from cases.rollout_gradients import assert_same, gradients, in_op, moving, single, with_gradients
from cases.rollouts import LAWS_HERE, SOME_TRANSFERS, TRANSFERS, assert_equal, in_one_op, one_by_one
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import blob, unit_box

F64, DT = torch.float64, 1e-4
SOLIDS = [name for name in LAWS_HERE if name != "fluid"]


def fibres(dim: int, device: str, count: int = 300, dtype: torch.dtype = F64) -> Tensor:
    """Fibre directions of particles; zero for every fifth."""
    d = torch.nn.functional.normalize(torch.randn(count, dim, dtype=F64), dim=1)
    d[::5] = 0
    return d.to(device, dtype)


def flexed(state: mpm.State, most: float = 3e3) -> mpm.State:
    """With a muscle activation of either sign for each particle."""
    a = most * torch.randn(len(state), generator=torch.Generator().manual_seed(4), dtype=F64).to(state.x)
    return state.replace(extra={**state.extra, "activation": a})


@torch.no_grad()
@pytest.mark.parametrize(
    *in_pairs(law=SOLIDS, n=[1, 2, 17], transfer=SOME_TRANSFERS, dtype=[torch.float32, F64], dim=[2, 3])
)
def test_muscles(law, n, transfer, dtype, dim, device):
    muscle = mpm.Active(LAWS_HERE[law](), fibres(dim, device, dtype=dtype))
    step = mpm.Step(unit_box(dim), muscle, gravity=(0.0, -9.8, 0.0)[:dim], walls="separate", **TRANSFERS[transfer])
    state = flexed(step.prepare(blob(device, dim, dtype=dtype)))
    state.x[5] = -3.0  # outside
    assert in_one_op(step, state)
    end = mpm.rollout(step, state, n, DT)
    assert_equal(end, one_by_one(step, state, n, DT))
    rest = mpm.rollout(step, state.replace(extra={**state.extra, "activation": torch.zeros_like(state.mass)}), n, DT)
    assert float((end.v - rest.v).abs().max()) > 1e-3 * n


@torch.no_grad()
@pytest.mark.parametrize("sort", [False, True])
def test_muscles_of_a_mixture(sort, dim, device):
    """Some materials have muscles, and fibres follow the particles in any order."""
    d = fibres(dim, device)
    muscles = [mpm.Active(LAWS_HERE[name](), d) for name in ("von_mises", "neo_hookean")]
    laws = [LAWS_HERE["sand"](), muscles[0], LAWS_HERE["fluid"](), muscles[1]]
    step = mpm.Step(unit_box(dim), mpm.Mixture(laws), gravity=(0.0, -9.8, 0.0)[:dim], walls="sticky")
    material = torch.arange(300, device=device).int() % 4
    state = step.prepare(blob(device, dim).replace(material=material, ids=torch.randperm(300).to(device)))
    state = flexed(state)
    state = state.sorted(step.grid) if sort else state
    assert in_one_op(step, state)
    assert_equal(mpm.rollout(step, state, 20, DT), one_by_one(step, state, 20, DT))


@torch.no_grad()
def test_muscles_in_scenes_with_obstacles_that_rearrange(device):
    """On the CPU the op puts particles into another order, and their muscle activations with them."""
    scenes, count = 2, 4000
    scene = (torch.arange(count, device=device) % scenes).int()
    path = lambda t: torch.stack([0.5 + 5 * t, 0.4 + 0 * t, 0.5 + 0 * t])  # noqa: E731
    step = mpm.Step(
        unit_box(3, scenes=scenes), mpm.Active(LAWS_HERE["fixed_corotated"](), (0.0, 1.0, 0.0)),
        boundaries=[mpm.Sphere(path, 0.1)], walls="slip",
    )  # fmt: skip
    state = flexed(step.prepare(blob(device, 3, count).replace(scene=scene)))
    assert in_one_op(step, state)
    assert_equal(mpm.rollout(step, state, 30, DT), one_by_one(step, state, 30, DT))


@pytest.mark.parametrize("law", ["neo_hookean", "von_mises", "viscoelastic", "sand"])
@pytest.mark.parametrize("every", [1, 3, mpm.Checkpoints(memory=1e9)], ids=str)
def test_gradients(law, every, dim, device):
    """By muscle activation, directions and moduli, beside a law that changes nothing and one that flows."""
    muscle = with_gradients(mpm.Active(LAWS_HERE[law](), fibres(dim, device).requires_grad_()))
    step = mpm.Step(unit_box(dim), muscle, walls="separate").to(device)
    state = flexed(moving(step, blob(device, dim)))
    got, expected = gradients(in_op(every), step, state), gradients(single(), step, state)
    for name in ("activation", "law.direction"):
        assert expected[name] is not None and float(expected[name].norm()) > 0
    assert_same(got, expected)


def test_gradients_of_a_mixture(dim, device):
    d = fibres(dim, device)[0].clone().requires_grad_()
    laws = [mpm.Active(LAWS_HERE["von_mises"](), d), LAWS_HERE["fluid"](), mpm.Active(LAWS_HERE["neo_hookean"](), d)]
    step = mpm.Step(unit_box(dim), with_gradients(mpm.Mixture(laws))).to(device)
    state = flexed(moving(step, blob(device, dim).replace(material=torch.arange(300, device=device).int() % 3)))
    assert_same(gradients(in_op(2), step, state), gradients(single(), step, state), "rollout")


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_a_controller_over_time(dtype, device):
    """A tensor of activations over time, which a hook hands out: the calls between two of them are one op."""
    step = mpm.Step(unit_box(2), mpm.Active(mpm.NeoHookean(E=1e4, nu=0.3), (0.6, 0.8)))
    start = step.prepare(blob(device, 2, dtype=dtype))

    def by(take: Callable[..., mpm.State]) -> tuple[Tensor, Tensor]:
        control = torch.linspace(-2e3, 2e3, 4, dtype=dtype, device=device).requires_grad_()

        def hand_out(state: mpm.State, k: int) -> mpm.State:
            return state.replace(extra={**state.extra, "activation": control[k // 5].expand(len(state))})

        end = take(hand_out)
        return end.x.detach(), torch.autograd.grad((end.x * end.v).sum(), control)[0]

    def from_python(hook: Callable[[mpm.State, int], mpm.State]) -> mpm.State:
        state = start
        for k in range(20):
            state = step(hook(state, k) if k % 5 == 0 else state, DT)
        return state

    got, expected = by(lambda hook: mpm.rollout(step, start, 20, DT, hook=hook, every=5)), by(from_python)
    for value, reference in zip(got, expected, strict=True):
        error = float((value - reference).norm() / reference.norm())
        assert error < (1e-4 if dtype == torch.float32 else 1e-12)


@torch.no_grad()
def test_an_activation_that_is_no_number_is_reported(device):
    """Not hidden, as a controller that diverges would like to be."""
    step = mpm.Step(unit_box(), mpm.Active(mpm.NeoHookean(E=1e4, nu=0.3), (1.0, 0.0, 0.0)))
    state = step.prepare(blob(device))
    state = state.replace(extra={**state.extra, "activation": torch.full_like(state.mass, float("nan"))})
    assert not bool(mpm.rollout(step, state, 3, DT).v.isfinite().all())
    assert bool(one_by_one(step, state, 3, DT).v.isnan().any())


def test_what_is_no_law_beside_another_is_refused(device):
    step = mpm.Step(unit_box(), mpm.Active(mpm.NeoHookean(E=1e4, nu=0.3), (1.0, 0.0, 0.0)))
    arguments = mpm.substeps_arguments(step, step.prepare(blob(device)), 2, DT)
    assert arguments["laws"] == "neo_hookean+fibre"
    for laws, message in (
        ("fibre+neo_hookean", r"a law after '\+' must be one that is added, got neo_hookean"),
        ("neo_hookean+", "law must be one of .*, got $"),
        ("neo_hookean,fibre", "several laws need material"),
    ):
        with pytest.raises(RuntimeError, match=message):
            torch.ops.torch_mpm.substeps(*(arguments | {"laws": laws}).values())
