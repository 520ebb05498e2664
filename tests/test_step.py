"""Whole steps and rollouts through the public API: published numbers, conservation, gradients, batches."""

import pytest
import torch
from helpers import TOLERANCE, random_particles, relative_error
from oracle import grid_update as grid_reference
from oracle import transfer as reference
from pairs import in_pairs

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block_state, make_step
from torch_mpm.grid.topology import Status


def mpm88(device):
    """The fluid of Taichi's mpm88 example: 4096 particles, 128² grid, linear pressure."""
    n, i = 128, torch.arange(4096, dtype=torch.float64)
    x = torch.stack([0.4 * (i % 64) / 64 + 0.2, 0.4 * i / 4096 + 0.05], 1)
    dx = 1 / n
    volume = torch.full((4096,), (dx / 2) ** 2)
    state = mpm.State(x=x.float(), v=torch.tensor([0.0, -3.0]).expand(4096, 2), mass=volume * 1.0, volume=volume).to(
        device
    )
    walls = mpm.Walls("separate", lower=(2 * dx, 2 * dx), upper=(126 * dx, 126 * dx))
    law = mpm.WeaklyCompressible(bulk_modulus=400.0, gamma=1.0)
    return mpm.Step(mpm.Grid(dx, (0, 0), (1, 1)), law, gravity=(0, -9.8), walls=walls), state


def test_mpm88_moments(device):
    """Means of x, x², x³, x⁴ over particles and axes, y doubled, published with Taichi's test of mpm88."""
    step, state = mpm88(device)
    with torch.no_grad():
        state = mpm.rollout(step, state, 500, 2e-4)
    step.check(state)
    x = state.x.double().cpu() * torch.tensor([1.0, 2.0])
    for power, published in enumerate((0.31722742, 0.15826741, 0.10224003, 0.07810827), 1):
        assert abs(float((x**power).mean()) - published) < 5e-5


@pytest.mark.parametrize(
    "options", [{}, {"stress_form": "gradient"}, {"grid": {"kernel": "cubic"}}, {"transfer": "pic"}]
)
def test_momentum_is_conserved(device, dim, options):
    """Without gravity and walls linear momentum stays, and APIC keeps angular momentum too, over 50 steps."""
    step = make_step(dim, **options)
    state = block_state(dim, device)

    def momenta(state):
        linear = (state.mass[:, None] * state.v).sum(0)
        outer = state.x.T @ (state.mass[:, None] * state.v)
        if state.C is not None:
            outer = outer + (state.mass[:, None, None] * state.C).sum(0).T / step.grid.inverse_inertia
        return linear, outer - outer.T

    start = momenta(state)
    state = mpm.rollout(step, state, 50, 2e-3)
    end = momenta(state)
    scale = float((state.mass[:, None] * state.v).abs().sum())
    assert float((end[0] - start[0]).abs().max()) < 1e-12 * scale
    if "transfer" not in options:
        assert float((end[1] - start[1]).abs().max()) < 1e-12 * scale


@pytest.mark.parametrize("many", [False, True])
def test_a_step_that_was_moved_goes_on(device, many):
    """The status of earlier steps moves with it."""
    step = make_step(2)
    state = block_state(2)
    with torch.no_grad():
        state = step(state, 1e-3)
        step, state = step.to(device), state.to(device)
        state = mpm.rollout(step, state, 5, 1e-3) if many else step(state, 1e-3)
    assert state.x.device.type == step.status.device.type == torch.device(device).type
    assert int(step.status[0, Status.ACTIVATIONS]) == (6 if many else 2)


def test_free_fall_is_exact(device, dim):
    """Symplectic Euler under gravity alone: x = x0 + n dt v0 + g dt² n (n + 1) / 2 for a rigid translation."""
    gravity = torch.linspace(-9.8, 1.0, dim, dtype=torch.float64)
    step = make_step(dim, gravity=gravity.to(device))
    start = block_state(dim, device, spin=0.0)
    n, dt = 20, 1e-3
    end = mpm.rollout(step, start, n, dt)
    expected = start.x + n * dt * start.v + dt**2 * n * (n + 1) / 2 * gravity.to(device)
    torch.testing.assert_close(end.x, expected, rtol=1e-12, atol=1e-13)
    assert end.time == pytest.approx(n * dt)


@pytest.mark.parametrize("options", [{"transfer": "flip"}, {"flip": 0.95}, {"transfer": "pic", "flip": 0.5}], ids=str)
@pytest.mark.parametrize(*in_pairs(walls=[None, "sticky", "mirror"], dim=[2, 3], kernel=["quadratic", "cubic"]))
def test_flip_is_the_reference(device, dim, kernel, options, walls):
    """(1 − flip) v_pic + flip (v + Σ N_i (v_i − v_i before the forces)); a mirror acts on both v_i."""
    gravity, dt = torch.linspace(-9.8, 1.0, dim, dtype=torch.float64, device=device), 1e-3
    step = make_step(dim, gravity=gravity, walls=walls, grid={"kernel": kernel}, **options)
    state = step.prepare(block_state(dim, device, low=0.0, spin=4.0))
    state = state.replace(C=state.x[:, :, None] * state.v[:, None], F=(1 + 0.1 * state.x[:, :1, None]) * state.F)
    end, blocks = step(state, dt), step.grid.activate(state.x)
    C = state.C if step.transfer == "apic" else None
    faces = [] if walls is None else step.walls.faces(step.grid)
    momentum = state.x, state.mass, state.v, C
    forced = reference.p2g(blocks, *momentum, step.law.stress(state), state.volume, dt)
    after = grid_reference.grid_update(blocks, forced, gravity, dt, faces)[:, 1:]
    mirrors = faces if walls == "mirror" else []
    free = reference.p2g(blocks, *momentum)
    before = grid_reference.grid_update(blocks, free, faces=mirrors)[:, 1:]
    pic, change = (reference.gather(blocks, state.x, v, 1.0)[0] for v in (after, after - before))
    share = options.get("flip", 1.0)
    assert (
        relative_error(end.v, (1 - share) * pic + share * (state.v + change)) < TOLERANCE["conservation"][torch.float64]
    )
    assert float(change.norm() / state.v.norm()) > 1e-2


@pytest.mark.parametrize("transfer,flip", [("apic", 0.0), ("pic", 0.0), ("apic", 0.9), ("flip", 1.0)])
def test_only_pic_damps_rotation(device, transfer, flip):
    """A rotating block loses no angular speed with FLIP, little with APIC, much with PIC (Jiang et al. 2015)."""
    step = make_step(2, E=1e3, transfer=transfer, flip=flip)
    state = block_state(2, device, spin=4.0)
    energy = lambda s: float((s.mass * ((s.v - s.v.mean(0)) ** 2).sum(1)).sum())  # noqa: E731
    first = mpm.rollout(step, state, 1, 1e-3)  # C starts at zero, so the first APIC step is a PIC step
    kept = energy(mpm.rollout(step, first, 100, 1e-3)) / energy(first)
    assert kept < 0.05 if transfer == "pic" else kept > 0.9


@pytest.mark.parametrize("transfer,flip", [("apic", 0.0), ("apic", 0.9), ("flip", 1.0)])
def test_no_transfer_gains_energy_in_a_collision(device, transfer, flip):
    """Two elastic discs hit each other: kinetic and elastic energy together never grow, and less is lost with FLIP."""
    grid = mpm.Grid(0.05, (0, 0), (2, 1))
    discs = [mpm.seed.sphere((x, y), 0.2, grid, per_cell=4) for x, y in ((0.7, 0.5), (1.3, 0.52))]
    state = mpm.State.concatenate(
        [
            mpm.State.at_rest(disc, 1000.0, velocity=(speed, 0.0), dtype=torch.float64, device=device)
            for disc, speed in zip(discs, (1.0, -1.0), strict=True)
        ]
    )
    step = mpm.Step(grid, mpm.NeoHookean(E=3e4, nu=0.3), transfer=transfer, flip=flip)
    state = step.prepare(state)

    def energy(s):
        return float((0.5 * s.mass * (s.v**2).sum(1)).sum() + step.law.energy(s).sum())

    start, history = energy(state), []
    for _ in range(10):
        state = mpm.rollout(step, state, 40, 1e-3)
        history.append(energy(state) / start)
    assert max(history) < 1.01 and history[-1] > (0.85 if flip else 0.6)


def test_rollout_gradient_is_the_finite_difference(device, dim):
    """50 substeps with contact, gravity and stress: every input against central differences, to 1e-6."""
    base = block_state(dim, device, low=0.1, high=0.3, dx=0.1)
    E = torch.tensor(2e4, dtype=torch.float64, device=device)
    inputs = {
        "x": base.x,
        "v": base.v,
        "mass": base.mass,
        "E": E,
        "g": torch.full((dim,), -5.0, dtype=torch.float64, device=device),
    }
    weights = torch.randn(base.x.shape, dtype=torch.float64).to(device)

    def loss(values):
        step = make_step(dim, E=values["E"], gravity=values["g"], walls="slip")
        state = mpm.rollout(step, base.replace(**{k: values[k] for k in ("x", "v", "mass")}), 50, 1e-3)
        return (weights * state.x).sum() + (state.v**2).sum() + (state.F**2).sum()

    leaves = {k: t.clone().requires_grad_() for k, t in inputs.items()}
    grads = dict(zip(leaves, torch.autograd.grad(loss(leaves), list(leaves.values())), strict=True))
    for name, value in inputs.items():
        direction = torch.randn(value.shape, dtype=torch.float64).to(device)
        step_size = 1e-6 * (float(value.abs().max()) or 1.0)
        with torch.no_grad():
            ends = [float(loss({**inputs, name: value + sign * step_size * direction})) for sign in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * step_size)
        assert float((grads[name] * direction).sum()) == pytest.approx(difference, rel=1e-6), name


def test_checkpointing_changes_nothing(device):
    results = []
    for every in (None, 1, 4, 10):
        state = block_state(2, device)
        v = state.v.clone().requires_grad_()
        E = torch.tensor(1e4, dtype=torch.float64, device=device, requires_grad=True)
        step = make_step(2, E=E, walls="slip", grid={"deterministic": True})
        end = mpm.rollout(step, state.replace(v=v), 10, 1e-3, checkpoint=every)
        (end.x**2).sum().backward()
        results.append((end.x.detach(), v.grad, E.grad))
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert relative_error(b, a) < 1e-13


def test_scenes_in_a_batch_are_as_if_alone(device, dim):
    """State, gradients with respect to the state, to E and gravity of each scene, for any other scenes."""
    E = torch.tensor([5e3, 1e4, 4e4], dtype=torch.float64, device=device)
    g = torch.tensor([[0.0] * dim, [-3.0] * dim, [2.0] * dim], dtype=torch.float64, device=device)
    dt = torch.tensor([1e-3, 2e-3, 5e-4], dtype=torch.float64, device=device)
    alone = [block_state(dim, device, low=0.2 + 0.1 * i, high=0.5 + 0.1 * i) for i in range(3)]
    packed = mpm.State.concatenate(alone, scene=True)
    packed = packed.select(torch.randperm(len(packed)).to(device))

    def run(state, E, g, dt, scenes):
        E, g, v = (t.clone().requires_grad_() for t in (E, g, state.v))
        step = make_step(dim, scenes, E=E, gravity=g, walls="separate")
        end = mpm.rollout(step, state.replace(v=v), 20, dt)
        loss = (end.x**2).sum() + (end.F**3).sum()
        return end, *torch.autograd.grad(loss, (v, E, g))

    end, grad_v, grad_E, grad_g = run(packed, E, g, dt, 3)
    for i, state in enumerate(alone):
        one, one_v, one_E, one_g = run(state, E[i : i + 1], g[i], dt[i], 1)
        members = (packed.scene == i).nonzero()[:, 0]
        order = torch.cdist(packed.x[members], state.x).argmin(0)
        members = members[order]
        assert relative_error(end.x[members], one.x) < 1e-14
        assert relative_error(end.F[members], one.F) < 1e-13
        assert relative_error(grad_v[members], one_v) < 1e-11
        assert relative_error(grad_E[i : i + 1], one_E) < 1e-11
        assert relative_error(grad_g[i], one_g) < 1e-11
        torch.testing.assert_close(end.time[i], one.time)


@pytest.mark.parametrize("law", [mpm.NeoHookean(E=1e4, nu=0.3), mpm.QuarticSand(E=1e4, nu=0.3)])
def test_tracking_changes_no_result(device, dim, law):
    """A step is the same whether autograd tracks it, is off, or is absent; tracked just where something needs it."""
    grid = mpm.Grid(0.1, (0,) * dim, (1,) * dim)
    step, state = mpm.Step(grid, law, gravity=(0, -9.8, 0)[:dim], walls="slip"), block_state(dim, device)
    tracked = mpm.rollout(step, state.replace(v=state.v.clone().requires_grad_()), 3, 1e-3)
    plain = mpm.rollout(step, state, 3, 1e-3)
    with torch.no_grad():
        off = mpm.rollout(step, state.replace(v=state.v.clone().requires_grad_()), 3, 1e-3)
    with torch.inference_mode():
        absent = mpm.rollout(step, state, 3, 1e-3)
    for name in ("x", "v", "C", "F"):
        assert getattr(tracked, name).requires_grad
        for other in (plain, off, absent):
            assert not getattr(other, name).requires_grad
            assert relative_error(getattr(other, name), getattr(tracked, name).detach()) < 1e-13


@pytest.mark.parametrize(
    "law", [mpm.NeoHookean(E=1e4, nu=0.3), mpm.FixedCorotated(E=1e4, nu=0.3), mpm.QuarticSand(E=1e4, nu=0.3)]
)
def test_a_step_can_be_tracked_after_inference(device, dim, law):
    """Cached tensors of a step may be created in inference mode and be saved for a gradient later."""
    grid = mpm.Grid(0.1, (0,) * dim, (1,) * dim)
    step = mpm.Step(grid, law, gravity=(0, -9.8, 0)[:dim], walls="slip")
    state = step.prepare(block_state(dim, device))
    with torch.inference_mode():
        expected = mpm.rollout(step, state, 2, 1e-3)
    leaves = {name: getattr(state, name).clone().requires_grad_() for name in ("v", "F")}
    end = mpm.rollout(step, state.replace(**leaves), 2, 1e-3)
    end.x.sum().backward()
    assert all(leaf.grad.isfinite().all() and leaf.grad.any() for leaf in leaves.values())
    assert relative_error(end.x.detach(), expected.x) < 1e-13


def test_sorting_keeps_identities(device):
    state = block_state(3, device)
    step = make_step(3, walls="slip")
    plain = mpm.rollout(step, state, 6, 1e-3)
    sorted_state = state
    for _ in range(3):
        sorted_state = mpm.rollout(step, sorted_state.sorted(step.grid), 2, 1e-3)
    back = sorted_state.restored()
    assert torch.equal(back.ids.cpu(), torch.arange(len(state)))
    assert relative_error(back.x, plain.x) < 1e-14
    assert relative_error(back.F, plain.F) < 1e-13


def test_sorting_orders_by_block_and_cell(device, dim, kernel):
    """Slots of the base blocks ascend, and cells within each; particles outside come last."""
    p = random_particles(dim, kernel, sizes=(900, 0, 300), device=device, extent=0.8)
    x = p.x.clone()
    x[[5, 700]] = torch.nan
    state = mpm.State(x, p.v, p.mass, p.volume, F=p.C, scene=p.scene).sorted(p.grid)
    assert torch.equal(state.ids.sort().values, torch.arange(1200, device=device))
    assert set(state.ids[-2:].tolist()) == {5, 700}
    assert torch.equal(state.F, p.C[state.ids]) and torch.equal(state.mass, p.mass[state.ids])
    assert state.F.stride(0) == 1
    x, scene = state.x[:-2].cpu(), state.scene[:-2].cpu().long()
    offset = 0.5 if kernel == "quadratic" else 1.0
    base = ((x - torch.tensor(p.grid.lower)) / p.grid.dx + 3 - offset).floor().long()
    key = scene
    for axis in range(dim):
        key = key * p.grid.blocks[axis] + base[:, axis] // 4
    for axis in range(dim):
        key = key * 4 + base[:, axis] % 4
    assert bool((key.diff() >= 0).all())


def test_a_network_acts_on_the_grid_and_a_module_is_the_law(device):
    """Gradients reach the weights of a module in the place of the law and of one acting on the grid."""
    net = torch.nn.Linear(2, 2).double().to(device)
    stiffness = torch.nn.Parameter(torch.tensor(100.0, dtype=torch.float64, device=device))
    law = mpm.CustomLaw(lambda F: stiffness * (F @ F.mT - torch.eye(2, dtype=F.dtype, device=F.device)))
    grid = mpm.Grid(0.1, (0, 0), (1, 1))

    def push(blocks, velocity, mass, dt):
        return velocity + dt * net(blocks.node_positions(velocity.dtype))

    step = mpm.Step(grid, law, on_grid=push)
    state = mpm.rollout(step, block_state(2, device), 5, 1e-3)
    (state.x**2).sum().backward()
    assert float(net.weight.grad.abs().min()) > 0 and float(stiffness.grad.abs()) > 0


def test_who_looks_at_the_time():
    """Moving obstacles and functions of the time do, in the heat too; and unknown modules may."""
    heat = mpm.heat_boundaries
    still, moving = (mpm.Sphere((0.5, 0.5), 0.1, velocity=v) for v in (None, (1.0, 0.0)))
    quiet = [heat.FixedSurface(still, 1.0), heat.Convection(heat.FreeSurface(), 1.0, 2.0), heat.Source(lambda T: T)]
    watching = [
        heat.Fixed(moving, 1.0),
        heat.FixedSurface(mpm.Sphere((0.5, 0.5), 0.1, start=1.0), 1.0),
        heat.Radiation(heat.FreeSurface(), 0.5, lambda time: time),
        heat.Flux(heat.FreeSurface(), lambda time: time),
    ]
    step = make_step(2, boundaries=[still])
    assert not step.reads_time
    step.heat = mpm.Heat(step.grid, 1.0, 1.0, boundaries=quiet)
    assert not step.reads_time
    for term in watching:
        step.heat.boundaries = [*quiet, term]
        assert step.reads_time
    step.heat = None
    for boundaries in ([moving], [still, torch.nn.Identity()]):
        step.boundaries = boundaries
        assert step.reads_time
    step.boundaries, step.on_particles = [], lambda state, dt: state
    assert step.reads_time


def test_problems_are_reported_with_the_particle_and_the_step(device):
    step = make_step(2)
    state = block_state(2, device)
    state = step(state, 1e-3)
    step.check(state)
    broken = state.replace(x=torch.where(torch.arange(len(state), device=device)[:, None] == 5, torch.nan, state.x))
    step(broken, 1e-3)
    with pytest.raises(mpm.SimulationError, match=r"1 particles had x that is NaN.*step 1: .*lowest index 5"):
        step.check()
    step.reset()
    gone = state.replace(v=torch.where(torch.arange(len(state), device=device)[:, None] == 3, 1e6, state.v))
    mpm.rollout(step, gone, 2, 1e-3)
    with pytest.raises(mpm.SimulationError, match=r"left the grid.*enlarge the domain"):
        step.check()
    step.reset()
    F = torch.eye(2, dtype=torch.float64, device=device).repeat(len(state), 1, 1)
    F[4, 0, 0] = -0.5
    inverted = step(state.replace(F=F), 1e-3)
    assert bool(torch.isfinite(inverted.x).all())
    with pytest.raises(mpm.SimulationError, match=r"inverted or not finite: .*lowest index 4"):
        step.check(inverted)


def test_a_full_grid_is_reported(device):
    state = block_state(2, device)
    step = make_step(2, grid={"max_blocks": 1})
    with pytest.raises(mpm.GridOverflowError, match="max_blocks=1"):
        step(state, 1e-3)
        step.check()


def test_the_grid_grows_with_the_scene():
    """Without `max_blocks` an explosion of the particles over the domain is followed on the CPU."""
    step = mpm.Step(mpm.Grid(0.01, (0, 0), (1, 1)), mpm.NeoHookean(E=1e4, nu=0.3))
    state = block_state(2)
    state = state.replace(x=0.4 + 0.05 * state.x)
    far = state.replace(x=torch.rand(len(state), 2, dtype=torch.float64))
    step(state, 1e-3)
    small = step.grid.max_blocks
    step(far, 1e-3)
    step.check()
    assert step.grid.max_blocks > small


def test_scenes_without_what_they_do_not_use(device):
    fluid = mpm.Step(mpm.Grid(0.1, (0, 0), (1, 1)), mpm.WeaklyCompressible(1e4))
    state = fluid(block_state(2, device), 1e-4)
    assert state.F is None and state.temperature is None and state.J is not None
    pic = make_step(2, transfer="pic")(block_state(2, device), 1e-4)
    assert pic.C is None


def test_compiles_to_one_graph(dim):
    step = make_step(dim, gravity=(0, -9.8, 1)[:dim], walls="slip")
    state = step.prepare(block_state(dim))
    eager = step(state, 1e-3)

    @torch.compile(backend="aot_eager", fullgraph=True)
    def compiled(x, v, C, F):
        out = step(mpm.State(x, v, state.mass, state.volume, C, F), 1e-3)
        return out.x, out.v, out.C, out.F

    first = compiled(state.x, state.v, torch.zeros_like(state.F), state.F)
    for a, b in zip(first, (eager.x, eager.v, eager.C, eager.F), strict=True):
        assert relative_error(a, b) < 1e-13


@pytest.mark.parametrize(
    "change,error,message",
    [
        ({"transfer": "xpic"}, ValueError, "transfer must be one of"),
        ({"flip": 1.5}, ValueError, "flip must be between 0 and 1"),
        ({"stress_form": "weak"}, ValueError, "stress_form must be"),
        ({"walls": "glue"}, ValueError, "kind of a wall must be one of"),
    ],
)
def test_bad_arguments(change, error, message):
    with pytest.raises(error, match=message):
        make_step(2, **change)


@pytest.mark.parametrize("dt", [0, -1e-3, float("nan")])
def test_bad_dt(dt):
    with pytest.raises(ValueError, match="dt must be a positive number"):
        make_step(2, gravity=(0, 1))(block_state(2), dt)


def test_bad_states():
    state = block_state(2)
    with pytest.raises(ValueError, match=r"v must have shape \[P, D\]"):
        state.replace(v=state.v[:3])
    with pytest.raises(TypeError, match="mass must have the dtype of x"):
        state.replace(mass=state.mass.float())
    with pytest.raises(ValueError, match="density must be positive"):
        mpm.State.at_rest(mpm.seed.box((0, 0), (1, 1), 0.1), density=-1.0)
    with pytest.raises(ValueError, match="scene must be given"):
        make_step(2, scenes=2)(state, 1e-3)


@pytest.mark.parametrize(
    "arguments,message",
    [
        (dict(dx=0.0, lower=(0, 0), upper=(1, 1)), "dx must be a positive number"),
        (dict(dx=0.1, lower=(0, 0), upper=(1, 0)), "upper must be above lower"),
        (dict(dx=0.1, lower=(0,), upper=(1,)), "2 or 3 numbers"),
        (dict(dx=0.1, lower=(0, 0), upper=(1, 1), kernel="linear"), "kernel must be one of"),
        (dict(dx=1e-6, lower=(0, 0, 0), upper=(1, 1, 1)), r"fewer than 2\^31"),
        (dict(dx=0.1, lower=(0, 0), upper=(1, 1), max_blocks=-1), "max_blocks must not be negative"),
    ],
)
def test_bad_grids(arguments, message):
    with pytest.raises(ValueError, match=message):
        mpm.Grid(**arguments)


@pytest.mark.cuda
def test_a_step_is_captured_in_a_cuda_graph():
    """Replays of a captured step equal eager steps."""
    step, state = mpm88("cuda")
    with torch.no_grad():
        state = mpm.rollout(step, state, 3, 2e-4)
        eager = mpm.rollout(step, state, 4, 2e-4)
        static = state.map(torch.clone)
        graph, side = torch.cuda.CUDAGraph(), torch.cuda.Stream()
        with torch.cuda.stream(side):
            step(static, 2e-4)
        torch.cuda.synchronize()
        with torch.cuda.graph(graph):
            out = step(static, 2e-4)
            for name in ("x", "v", "C", "J"):
                getattr(static, name).copy_(getattr(out, name))
        for _ in range(4):
            graph.replay()
    assert relative_error(static.x, eager.x) < 1e-6


@pytest.mark.cuda
@pytest.mark.parametrize("inference", [False, True])
def test_replays_of_a_graph_are_watched(inference):
    """Problems of any replay are reported, also after other uses of the step and its memory."""
    step, state = mpm88("cuda")
    with torch.inference_mode(inference), torch.no_grad():
        static = step(state, 2e-4).map(torch.clone)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            for _ in range(2):
                step(static, 2e-4)
        step(state, 2e-4)
        scribble = [torch.full((8,), 7, dtype=torch.int32, device="cuda") for _ in range(100)]
        for _ in range(3):
            graph.replay()
        step.check()
        activations = [status[0, Status.ACTIVATIONS].item() for status in step._error_status.all()]
        assert activations == [2, 7]  # of eager steps, and with replays
        inside = static.x[5].clone()
        static.x[5] = -9.0
        graph.replay()
        static.x[5] = inside
        graph.replay()
        with pytest.raises(mpm.SimulationError, match=r"1 particles left the grid .* at step 7, lowest index 5"):
            step.check()
        step.reset()
        graph.replay()
        step.check()
    assert all(bool((t == 7).all()) for t in scribble)


@pytest.mark.cuda
@pytest.mark.parametrize("law", [mpm.NeoHookean(E=1e4, nu=0.3), mpm.QuarticSand(E=1e4, nu=0.3)])
def test_a_graph_keeps_what_it_was_captured_with(law):
    """Replays are not touched by what the step, its law or an obstacle is used for in between."""
    grid = mpm.Grid(0.1, (0, 0), (1, 1))
    ball = mpm.Sphere((0.5, 0.2), 0.15)
    step = mpm.Step(grid, law, gravity=(0, -9.8), walls="slip", boundaries=[ball])
    state = block_state(2, "cuda").map(torch.clone)
    with torch.no_grad():
        state = step(state, 1e-3)
        expected = step(state, 1e-3)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            end = step(state, 1e-3)
        law.E, ball.radius, step.gravity = 2e4, 0.2, (0, 5.0)
        for dtype in (torch.float32, torch.float64):
            step(state.map(lambda t, to=dtype: t.to(to) if t.is_floating_point() else t), 1e-3)
        scribble = [torch.full((8,), 7.0, dtype=torch.float64, device="cuda") for _ in range(200)]
        graph.replay()
    law.E = 1e4
    assert all(relative_error(getattr(end, k), getattr(expected, k)) < 1e-13 for k in ("x", "v", "F"))
    assert all(bool((t == 7).all()) for t in scribble)
