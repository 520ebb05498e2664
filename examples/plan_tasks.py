"""Improve plans for the tasks of `torch_mpm.envs` by gradients through the simulation.

A plan is a sequence of actions for one scene, from a simple first guess that touches the material.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_mpm import envs


class Guess(NamedTuple):
    """First plan of a task: actions of phases, each for a number of steps; number of iterations, and their rate."""

    task: Callable[..., envs.MaterialEnv]
    dx: float
    iterations: int
    phases: Sequence[tuple[int, Sequence[float]]]
    rate: float = 0.03


GUESSES = {
    "push": Guess(envs.Push, 0.05, 15, [(30, (0.1, 0.0))]),
    "roll": Guess(envs.Roll, 0.05, 15, [(10, (0.0, -0.3)), (15, (0.3, 0.0)), (15, (-0.3, 0.0))]),
    "pour": Guess(envs.Pour, 0.04, 15, [(20, (0.5, 0.0, 0.0)), (60, (0.0, 0.0, -0.7))]),
    "scoop": Guess(
        *(envs.Scoop, 0.03, 8),
        [(20, (0.3, -0.9, -0.7)), (30, (0.9, 0.0, 0.0)), (20, (0.6, 0.2, 0.7)), (30, (0.0, 0.8, 0.3))],
        rate=0.01,
    ),
    "lift": Guess(envs.Lift, 0.03, 20, [(6, (0.4, -0.4, 0.0)), (24, (0.1, -0.1, 0.1))]),
    "write": Guess(envs.Write, 0.04, 6, [(15, (0.0, 0.0, -0.5)), (25, (-0.1, 0.1, 0.0))]),
}


def first_plan(guess: Guess) -> Tensor:
    """Actions [N, 1, A]."""
    return torch.cat([torch.tensor(action).expand(n, 1, -1) for n, action in guess.phases])


def total(env: envs.MaterialEnv, plan: Tensor, seed: int = 0) -> Tensor:
    """Sum of the rewards of a plan."""
    env.reset(seed=seed)
    rewards = [env.step(action)[1] for action in plan]
    return torch.stack(rewards).sum()


def improve(guess: Guess, device: str = "cpu") -> tuple[Tensor, list[float]]:
    """Returns the best plan, and the sum of rewards before each iteration."""
    options: dict[str, Any] = {"autoreset_mode": "Disabled", "differentiable": True, "device": device}
    env = guess.task(1, guess.dx, **options)
    plan = first_plan(guess).to(device).requires_grad_()
    optimizer = torch.optim.Adam([plan], lr=guess.rate)
    best, rewards = plan.detach().clone(), []
    for _ in range(guess.iterations):
        reward = total(env, plan)
        if not rewards or reward.item() > max(rewards):
            best = plan.detach().clone()
        rewards.append(reward.item())
        optimizer.zero_grad()
        (-reward).backward()
        optimizer.step()
        with torch.no_grad():
            plan.clamp_(-1.0, 1.0)
    return best, rewards


@torch.no_grad()
def last_picture(guess: Guess, plan: Tensor, device: str) -> np.ndarray:
    """The scene at the end of a plan."""
    env = guess.task(1, guess.dx, autoreset_mode="Disabled", render_mode="rgb_array", device=device)
    total(env, plan)
    (picture,) = env.render()
    env.close()
    return picture


def draw(found: dict[str, tuple[Tensor, list[float]]], path: Path, device: str) -> None:
    """For each task the end of the first and of the best plan, and the rewards."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 2.2 * len(found)), dpi=100)
    rows = figure.subplots(len(found), 3, squeeze=False)
    for (name, (plan, rewards)), (first, best, curve) in zip(found.items(), rows, strict=True):
        guess = GUESSES[name]
        for axes, actions, title in ((first, first_plan(guess), "first plan"), (best, plan, "best plan")):
            axes.imshow(last_picture(guess, actions, device))
            axes.set_title(f"{name}: {title}", fontsize=9)
            axes.axis("off")
        curve.plot(rewards, ".-")
        curve.set_title("sum of rewards", fontsize=9)
    curve.set_xlabel("iteration")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def main(out: Path, device: str = "cpu", tasks: Sequence[str] = tuple(GUESSES)) -> dict[str, tuple[float, float]]:
    """Returns the sum of rewards of the first and the best plan of each task."""
    found = {}
    for name in tasks:
        found[name] = improve(GUESSES[name], device)
        rewards = found[name][1]
        print(f"{name}: reward {rewards[0]:.4f} of the first plan, {max(rewards):.4f} of the best one", flush=True)
    draw(found, out / "plan_tasks.png", device)
    return {name: (rewards[0], max(rewards)) for name, (_, rewards) in found.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/plan_tasks"), help="folder of the picture")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--tasks", nargs="+", choices=GUESSES, default=list(GUESSES))
    torch.set_num_threads(1)  # A few thousand particles: more threads would only wait for each other.
    options, begin = parser.parse_args(), time.perf_counter()
    main(options.out, options.device, options.tasks)
    print(f"{time.perf_counter() - begin:.0f} s; see {options.out / 'plan_tasks.png'}")
