"""The simulator and the laws of NCLaw against their published step, restated in NumPy; its networks on them."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from compat.restated import EYE, Weights, corotated, from_grid, lame, nodes_of, rotations_svd, to_grid
from torch import nn

from torch_mpm.compat.nclaw import material, sim, warp

N, DT, BOUND = 20, 5e-4, 3
SIM = {"num_grids": N, "dt": DT, "bound": BOUND, "gravity": [0.0, -9.8, 0.0], "bc": "freeslip", "num_steps": 100}
NETWORK = SimpleNamespace(
    layer_widths=[16, 16], no_bias=True, norm=None, nonlinearity="gelu", normalize_input=True, alpha=1e-2
)


class Restated:
    """MLS form; the mass of a node with eps, gravity, no velocity out of the cube, positions clamped."""

    def __init__(self, x, v, mass, volume, eps, clip):
        self.x, self.v, self.C = x.copy(), v.copy(), np.zeros((len(x), 3, 3))
        self.F, self.mass, self.volume = np.tile(EYE, (len(x), 1, 1)), mass, volume
        self.eps, self.clip = eps, clip / N
        self.index = np.rint(nodes_of(N, 1 / N) * N).astype(int)

    def step(self, stress, enabled):
        here = Restated(self.x[enabled], self.v[enabled], self.mass[enabled], self.volume[enabled], self.eps, 0)
        weights = Weights(here.x, 1 / N, N)
        m, mv = to_grid(weights, N, here.mass, here.v, self.C[enabled], here.volume, stress[enabled], DT, True, 1 / N)
        v = mv / np.where(m > 0, m + self.eps, 1)[:, None] + DT * np.array(SIM["gravity"])
        for k in range(3):
            v[(self.index[:, k] < BOUND) & (v[:, k] < 0), k] = 0
            v[(self.index[:, k] > N - BOUND) & (v[:, k] > 0), k] = 0
        self.v[enabled], self.C[enabled], _ = from_grid(weights, v, 1 / N)
        self.F[enabled] = (EYE + DT * self.C[enabled]) @ self.F[enabled]
        clip = self.clip[enabled, None]
        self.x[enabled] = np.clip(self.x[enabled] + DT * self.v[enabled], clip, 1 - clip)


def bodies(eps, device):
    """Two boxes, the second one added later: model, statics, initial tensors and the restated simulator."""
    model = sim.MPMModelBuilder().parse_cfg(SIM | {"eps": eps}).finalize(device, requires_grad=True)
    shape = {"type": "cube", "center": [0.4, 0.2, 0.5], "size": [0.2, 0.2, 0.1], "resolution": 5, "mode": "random"}
    low = sim.MPMInitData.get({"rho": 1e3, "clip_bound": 0.5, "span": [0, 1000], "shape": shape})
    shape = shape | {"center": [0.62, 0.4, 0.5], "mode": "uniform"}
    late = sim.MPMInitData.get({"rho": 5e2, "clip_bound": 6.5, "span": [30, 1000], "shape": shape})
    late.set_lin_vel([1.0, -2.0, 0.0])
    late.set_ang_vel([0.0, 0.0, 5.0])
    states, statics = sim.MPMStateInitializer(model), sim.MPMStaticsInitializer(model)
    for group in (low, late):
        states.add_group(group)
        statics.add_group(group)
    state, sections = states.finalize()
    assert sections == [low.num_particles, late.num_particles] == [50, 50]
    x = np.concatenate([low.pos, late.pos])
    turned = np.cross([0, 0, 5.0], late.pos - [0.62, 0.4, 0.5])
    v = np.concatenate([0 * low.pos, [1.0, -2.0, 0.0] + turned])
    np.testing.assert_allclose(state.particle.v.cpu().numpy(), v, atol=1e-6)
    volume = np.full(100, 0.2 * 0.2 * 0.1 / 50)
    rows = np.repeat([0, 1], 50)
    own = Restated(x, v, np.array([1e3, 5e2])[rows] * volume, volume, eps, np.array([0.5, 6.5])[rows])
    return model, statics, own


@pytest.mark.parametrize("eps", [0.0, 1e-7, 1e-3])
def test_trajectories(eps, device):
    """100 steps of two bodies, the second from step 30 on."""
    model, statics_initializer, own = bodies(eps, device)
    statics = statics_initializer.finalize()
    x, v = (torch.tensor(t, device=device) for t in (own.x, own.v))
    C = torch.zeros(len(x), 3, 3, dtype=x.dtype, device=device)
    F = torch.eye(3, dtype=x.dtype, device=device).repeat(len(x), 1, 1)
    law = material.CorotatedElasticity({"E": 1e5, "nu": 0.3}).to(device).requires_grad_(False)
    E = float(law.log_E.double().exp())
    diff = sim.MPMCacheDiffSim(model, 100)
    start = own.x.copy()
    for step in range(100):
        statics_initializer.update(statics, step)
        x, v, C, F = diff(statics, step, x, v, C, F, law(F))
        own.step(corotated(own.F, *lame(E, 0.3)), np.repeat([True, step >= 30], 50))
        if step == 29:
            assert torch.equal(x[50:].cpu(), torch.tensor(start[50:]))
    assert np.abs(x.cpu().numpy() - own.x).max() < 1e-7
    assert np.abs(own.x - start).max() > 0.04
    assert own.x[50:].min() == pytest.approx(6.5 / N)  # the clamp has acted


def test_forward_simulator_keeps_its_state(device):
    """In float32, without gradients, and as the differentiable one."""
    model, initializer, own = bodies(0.0, device)
    statics = initializer.finalize()
    states = sim.MPMStateInitializer(model)
    states.groups = initializer.groups
    state, _ = states.finalize()
    law = material.CorotatedElasticity({"E": 1e5, "nu": 0.3}).to(device)
    x, v, C, F, _ = state.to_torch()
    for _ in range(5):
        state.from_torch(stress=law(state.particle.F).detach())
        after = sim.MPMForwardSim(model)(statics, state)
        x, v, C, F = sim.MPMDiffSim(model)(statics, x, v, C, F, law(F).detach())
    assert torch.equal(state.particle.x, after[0])
    noise = 0 if device == "cpu" else 1e-5  # sums on CUDA have no order
    speed = float(v.abs().max())
    for a, b, scale in zip(after, (x, v, C, F), (1, speed, speed * N, 1), strict=True):  # C: velocities over dx
        torch.testing.assert_close(a, b, rtol=noise, atol=noise * scale)
    assert not after[0].requires_grad and x.dtype == torch.float32
    assert len(own.x) == len(x)


ELASTIC = ["PlainMetaElasticity", "PolarMetaElasticity", "InvariantMetaElasticity", "InvariantFullMetaElasticity"]
PLASTIC = ["PlainMetaPlasticity", "PolarMetaPlasticity", "InvariantFullMetaPlasticity"]


@pytest.mark.parametrize("name", ELASTIC + PLASTIC)
def test_networks_are_differentiable_at_rest(name, device):
    """At F = I and at equal stretches, against central differences where the features are smooth, which sorted σ are
    not; and finite for all."""
    law = getattr(material, name)(NETWORK).double().to(device)
    assert set(law.state_dict()) == {"layers.0.fc.weight", "layers.1.fc.weight", "final_layer.fc.weight"}
    F = torch.eye(3, dtype=torch.float64, device=device).repeat(2, 1, 1)
    F[1] = torch.diag(torch.tensor([1.2, 1.2, 0.9], dtype=torch.float64))
    leaf = F.clone().requires_grad_()
    weights = torch.randn(2, 3, 3, dtype=torch.float64).to(device)
    loss = lambda F: (law(F) * weights).sum()  # noqa: E731
    grads = torch.autograd.grad(loss(leaf), [leaf, *law.parameters()])
    assert all(bool(g.isfinite().all()) for g in grads)
    if "Full" in name:
        return
    along = torch.randn(2, 3, 3, dtype=torch.float64).to(device)
    with torch.no_grad():
        difference = (loss(F + 1e-6 * along) - loss(F - 1e-6 * along)) / 2e-6
    assert float((grads[0] * along).sum()) == pytest.approx(float(difference), rel=1e-6)


def test_the_network_is_the_published_one():
    """R sym M Fᵀ of the features σ − 1, FᵀF − 1, det F − 1, through weights in NumPy."""
    law = material.InvariantFullMetaElasticity(NETWORK).double()
    F = EYE + 0.2 * np.random.default_rng(0).normal(size=(20, 3, 3))
    U, s, Vh = rotations_svd(F)
    x = np.concatenate([s - 1, (F.transpose(0, 2, 1) @ F - EYE).reshape(-1, 9), np.linalg.det(F)[:, None] - 1], 1)
    for name in ("layers.0", "layers.1", "final_layer"):
        x = x @ law.state_dict()[f"{name}.fc.weight"].numpy().T
        if name != "final_layer":
            x = nn.functional.gelu(torch.tensor(x)).numpy()
    M = x.reshape(-1, 3, 3)
    expected = (U @ Vh) @ (M + M.transpose(0, 2, 1)) / 2 @ F.transpose(0, 2, 1)
    np.testing.assert_allclose(law(torch.tensor(F)).detach().numpy(), expected, atol=1e-12)


def test_a_decomposition_of_rotations_has_right_gradients(device):
    """σ and R = U Vᵀ of `SVD`, against central differences, at F = I too."""
    decompose = warp.SVD()
    weights = torch.randn(3, 3, dtype=torch.float64).to(device)

    def loss(F):
        U, sigma, Vh = decompose(F)
        return ((U @ Vh) * weights).sum() + sigma.square().sum()

    for F in (torch.eye(3), torch.diag(torch.tensor([1.1, 1.1, 0.7])), torch.eye(3) + 0.1 * torch.randn(3, 3)):
        F = F.double().to(device)[None]
        leaf = F.clone().requires_grad_()
        (grad,) = torch.autograd.grad(loss(leaf), leaf)
        along = torch.randn(1, 3, 3, dtype=torch.float64).to(device)
        with torch.no_grad():
            difference = (loss(F + 1e-6 * along) - loss(F - 1e-6 * along)) / 2e-6
        assert float((grad * along).sum()) == pytest.approx(float(difference), rel=1e-6)


def test_training_recovers_a_law_through_the_simulator(device):
    """Gradient descent on log E by what a softer body did, through 20 steps, with plasticity after each."""
    model, initializer, own = bodies(0.0, device)
    statics = initializer.finalize()
    start = torch.tensor(own.x, device=device), torch.tensor(own.v, device=device)
    diff = sim.MPMDiffSim(model)

    def run(elastic, plastic):
        x, v = start
        v = v + 3 * (x - x.mean(0))
        C = torch.zeros(len(x), 3, 3, dtype=x.dtype, device=device)
        F = torch.eye(3, dtype=x.dtype, device=device).repeat(len(x), 1, 1)
        for _ in range(20):
            x, v, C, F = diff(statics, x, v, C, F, elastic(F))
            F = plastic(F)
        return v

    plastic = material.VonMisesPlasticity({"E": 1e5, "nu": 0.3, "sigma_y": 2e3}).to(device).requires_grad_(False)
    with torch.no_grad():
        seen = run(material.CorotatedElasticity({"E": 5e4, "nu": 0.3}).to(device), plastic)
    law = material.CorotatedElasticity({"E": 1e5, "nu": 0.3}).to(device)
    optimizer = torch.optim.Adam(law.parameters(), lr=0.2)
    slower = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.8)
    for _ in range(12):
        loss = (run(law, plastic) - seen).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        slower.step()
    assert float(law.log_E.detach().exp()) == pytest.approx(5e4, rel=0.1)


@pytest.mark.parametrize(
    "name", ["SVDMetaElasticity", "SplineMetaElasticity", "SVDMetaPlasticity", "SplineMetaPlasticity"]
)
def test_laws_without_gradient_at_rest_are_refused(name):
    with pytest.raises(NotImplementedError, match=f"{name} has no gradient where two stretches are equal"):
        getattr(material, name)(NETWORK)


def test_particles_without_mass_are_refused():
    model = sim.MPMModelBuilder().parse_cfg(SIM | {"eps": 0.0}).finalize()
    with pytest.raises(NotImplementedError, match="MPMExtraSim moves particles without mass"):
        sim.MPMExtraSim(model)


def test_what_cannot_be_done_is_said():
    with pytest.raises(ValueError, match="'noslip' sets no velocity at all"):
        sim.MPMModelBuilder().parse_cfg(SIM | {"bc": "noslip"})
    with pytest.raises(ValueError, match="the configuration must have eps"):
        sim.MPMModelBuilder().parse_cfg(SIM)
    with pytest.raises(ValueError, match="call parse_cfg first"):
        sim.MPMModelBuilder().finalize()
    with pytest.raises(ValueError, match="shape must be of type 'cube' or 'mesh', got 'cylinder'"):
        sim.MPMInitData.get({"shape": {"type": "cylinder"}})
    with pytest.raises(ValueError, match="nonlinearity must be one of"):
        material.PlainMetaElasticity(SimpleNamespace(**{**vars(NETWORK), "nonlinearity": "step"}))
    model = sim.MPMModelBuilder().parse_cfg(SIM | {"eps": 0.0}).finalize()
    empty = torch.zeros(0, 3), torch.zeros(0, 3), *(torch.zeros(0, 3, 3),) * 3
    after = sim.MPMDiffSim(model)(model.statics(0), *empty)
    assert [len(t) for t in after] == [0, 0, 0, 0]
    with pytest.raises(TypeError, match="statics must be an MPMStatics, got int"):
        sim.MPMDiffSim(model)(3, *empty)
