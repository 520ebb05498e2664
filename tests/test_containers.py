"""States as torch's own containers: pytrees, files that hold no code, batches of a DataLoader, parts by scene."""

import io

import pytest
import torch
from torch.utils import _pytree
from torch.utils.data import DataLoader, Dataset

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block_state, make_step
from torch_mpm.state.pytree import from_tensordict, to_tensordict


def full_state(device="cpu"):
    state = make_step(2).prepare(block_state(2, device))
    return state.replace(extra={"h": torch.ones(len(state), 2, 3, dtype=torch.float64, device=device)}, time=0.25)


def test_a_state_is_a_pytree_of_its_tensors(device):
    state = full_state(device)
    leaves, layout = _pytree.tree_flatten(state)
    assert all(isinstance(leaf, torch.Tensor) for leaf in leaves) and len(leaves) == 6
    same = _pytree.tree_unflatten(leaves, layout)
    assert same.F is state.F and same.extra["h"] is state.extra["h"] and same.C is None and same.time == 0.25
    doubled = _pytree.tree_map(lambda t: 2 * t, {"start": state})["start"]
    assert torch.equal(doubled.x, 2 * state.x) and torch.equal(doubled.extra["h"], 2 * state.extra["h"])
    keys = [str(path[0]) for path, _ in _pytree.tree_flatten_with_path(state)[0]]
    assert keys == [".x", ".volume", ".v", ".mass", ".F", ".extra.h"]
    several = state.replace(extra={"v": state.mass, "volume": 2 * state.mass, "b": 3 * state.mass})
    same = _pytree.tree_map(lambda t: t, several)
    assert list(same.extra) == ["v", "volume", "b"] and all(same.extra[k] is several.extra[k] for k in same.extra)
    timed = state.replace(time=torch.tensor([0.5], dtype=torch.float64, device=device))
    assert float(_pytree.tree_map(lambda t: 2 * t, timed).time) == 1.0
    assert _pytree.tree_map(lambda t: tuple(t.shape), state).extra == {"h": (len(state), 2, 3)}


def test_transforms_of_torch_take_states(device):
    """`torch.func.vjp` by a whole state is backward by its tensors."""
    step, state = make_step(2), full_state(device)
    after, pull_back = torch.func.vjp(lambda s: step(s, 1e-3), state)
    seed = _pytree.tree_map(torch.ones_like, after)
    (by_state,) = pull_back(seed)
    x = state.x.clone().requires_grad_()
    outputs = _pytree.tree_leaves(step(state.replace(x=x), 1e-3))
    total = sum(t.sum() for t in outputs if t.requires_grad)
    torch.testing.assert_close(by_state.x, torch.autograd.grad(total, x)[0], rtol=1e-12, atol=1e-12)


def test_files_without_code(device):
    state = full_state(device)
    file = io.BytesIO()
    torch.save({"state": state}, file)
    file.seek(0)
    loaded = torch.load(file, weights_only=True)["state"]
    assert torch.equal(loaded.x, state.x) and torch.equal(loaded.extra["h"], state.extra["h"]) and loaded.time == 0.25
    torch.testing.assert_close(make_step(2)(loaded, 1e-3).x, make_step(2)(state, 1e-3).x)


def test_tensordicts(device):
    """There and back, with gradients, after what TensorDicts are used for; a number and a tensor as the time."""
    pytest.importorskip("tensordict")
    for time in (0.25, torch.tensor([0.25], dtype=torch.float64, device=device)):
        state = full_state(device).replace(time=time)
        state = state.replace(v=state.v.clone().requires_grad_())
        fields = to_tensordict(state)
        assert fields["x"] is state.x and "C" not in fields.keys()
        back = from_tensordict(fields.clone())
        assert type(back.time) is type(time) and torch.as_tensor(back.time).tolist() == torch.as_tensor(time).tolist()
        leaves = zip(_pytree.tree_leaves(back), _pytree.tree_leaves(state), strict=True)
        assert all(torch.equal(torch.as_tensor(a), torch.as_tensor(b)) for a, b in leaves)
        (grad,) = torch.autograd.grad(make_step(2)(back, 1e-3).x.sum(), state.v)
        assert float(grad.abs().sum()) > 0
    with pytest.raises(TypeError, match="colour"):
        from_tensordict(fields.set("colour", state.x))


class Throws(Dataset):
    def __len__(self):
        return 4

    def __getitem__(self, k):
        state = block_state(2)
        return {"start": state.replace(v=state.v + k), "target": torch.tensor(float(k))}


@pytest.mark.thorough(context="spawn")
@pytest.mark.parametrize(("workers", "context"), [(0, None), (2, "fork"), (1, "spawn")])
def test_a_data_loader_makes_batches_of_scenes(workers, context):
    """Also from worker processes; each scene moves as it does alone."""
    step = make_step(2, scenes=2)
    loader = DataLoader(Throws(), batch_size=2, num_workers=workers, multiprocessing_context=context)
    for number, batch in enumerate(loader):
        assert batch["target"].tolist() == [2.0 * number, 2.0 * number + 1]
        ends = mpm.rollout(step, batch["start"], 3, 1e-3).split()
        for k, end in enumerate(ends):
            alone = mpm.rollout(make_step(2), Throws()[2 * number + k]["start"], 3, 1e-3)
            torch.testing.assert_close(end.x, alone.x, rtol=0, atol=1e-14)


def test_split_is_the_inverse_of_concatenate(device):
    states = [full_state(device), full_state(device).select(torch.arange(0, device=device)), full_state(device)]
    states[2] = states[2].replace(x=states[2].x + 0.1)
    packed = mpm.State.concatenate(states, scene=True, scenes=[1, 1, 1])
    generator = torch.Generator().manual_seed(0)
    parts = packed.select(torch.randperm(len(packed), generator=generator).to(device)).split(3)
    assert [len(p) for p in parts] == [len(s) for s in states] and all(p.scene is None for p in parts)
    for part, state in zip(parts, states, strict=True):
        order = part.x[:, 0].argsort(), state.x[:, 0].argsort()
        assert torch.equal(part.F[order[0]], state.F[order[1]]) and torch.equal(part.x[order[0]], state.x[order[1]])
    times = packed.replace(time=torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64, device=device)).split()
    assert [float(p.time) for p in times] == [0.0, 1.0, 2.0]
    with pytest.raises(ValueError, match=r"scenes\[0\] must be above 2"):
        packed.split(2)
