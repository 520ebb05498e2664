"""Implicit steps with an obstacle whose gradients are checked."""

import torch

import torch_mpm as mpm


def parameters(dim, device):
    """Parameters of a rotating obstacle that moves down on the block of `inputs`."""
    turn = (0.1,) if dim == 2 else (0.1, 0.2, 0.3)
    given = {
        "position": (0.55, 0.57, 0.4)[:dim],
        "velocity": (0.4, -1.0, 0.3)[:dim],
        "rotation": turn,
        "angular_velocity": tuple(3 * w for w in turn),
        "direction": (0.2, -0.8, 0.3)[:dim],
        "friction": 0.2,
    }
    values = {name: torch.tensor(value, dtype=torch.float64, device=device) for name, value in given.items()}
    if dim == 2:
        values["rotation"], values["angular_velocity"] = (values[n][0] for n in ("rotation", "angular_velocity"))
    return values


def obstacle(shape, p, kind, rubs=True):
    rest = {"velocity": p["velocity"], "rotation": p["rotation"], "angular_velocity": p["angular_velocity"]}
    rest |= {"kind": kind, "friction": p["friction"] if rubs else 0.0}
    if shape == "plane":
        return mpm.Plane(p["position"], p["direction"], **rest)
    if shape == "capsule":
        return mpm.Capsule(p["position"], p["direction"] / 4, 0.13, **rest)
    if shape == "box":
        return mpm.Box(p["position"], (0.45, 0.3, 0.45)[: len(p["position"])], **rest)
    return mpm.Sphere(p["position"], 0.2, **rest)


def check(loss, values, names, nothing=()):
    """The gradient of a loss by each name, along a random direction, against central differences; that by what changes
    nothing is zero, to the rounding of the others."""
    leaves = {name: values[name].clone().requires_grad_() for name in (*names, *nothing)}
    grads = torch.autograd.grad(loss({**values, **leaves}), list(leaves.values()), materialize_grads=True)
    assert all(float(g.norm()) < 1e-9 * float(grads[0].norm()) for g in grads[len(names) :])
    for name, grad in zip(names, grads, strict=False):
        direction = torch.randn_like(values[name]) * values[name].abs().mean()
        with torch.no_grad():
            ends = [loss({**values, name: values[name] + h * direction}) for h in (1e-5, -1e-5)]
        difference, terms = (ends[0] - ends[1]) / 2e-5, grad * direction
        assert bool(terms.abs().sum() > 0), name
        assert float((terms.sum() - difference).abs() / terms.norm()) < 1e-5, name
