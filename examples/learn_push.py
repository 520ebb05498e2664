"""Train a network that pushes a soft lump to a target, by gradients through the simulation, and test it on new scenes.

The network observes the lump and the target in each step of the environment, and moves the disc that pushes.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from torch_mpm import render
from torch_mpm.envs import Push

SCENES, STEPS = 8, 30  # scenes of an iteration, and steps of an episode
SCALE = 5.0  # of the observations, which differ by some 0.2 m and 0.2 m/s
TEST = 10**6  # seed of the first scene of the test


def network(seed: int = 0) -> nn.Module:
    """Actions in [-1, 1] by observations."""
    torch.manual_seed(seed)
    layers = nn.Sequential(nn.Linear(Push.OBSERVATIONS, 32), nn.Tanh(), nn.Linear(32, Push.ACTIONS), nn.Tanh())
    with torch.no_grad():
        layers[2].weight.mul_(0.1)
        layers[2].bias.copy_(torch.tensor([0.1, 0.0]))  # To the right: gradients need contact.
    return layers


def episode(env: Push, policy: nn.Module, seed: int) -> Tensor:
    """Sums of the rewards of an episode, [B]."""
    observation, _ = env.reset(seed=seed)
    total = torch.zeros(env.num_envs, device=env.device)
    for _ in range(STEPS):
        observation, reward, *_ = env.step(policy(SCALE * observation))
        total = total + reward
    return total


def train(iterations: int, device: str = "cpu", scenes: int = SCENES) -> tuple[nn.Module, list[float], list[float]]:
    """Returns the policy, and for each iteration the mean sum of rewards before it, in new scenes and in the
    test."""
    options = {"autoreset_mode": "Disabled", "max_episode_steps": STEPS, "device": device}
    env, test = Push(scenes, differentiable=True, **options), Push(scenes, **options)
    policy = network().to(device)
    optimizer = torch.optim.Adam(policy.parameters(), lr=0.01)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations)
    training, tests = [], []
    for k in range(iterations):
        with torch.no_grad():
            tests.append(episode(test, policy, TEST).mean().item())
        total = episode(env, policy, seed=scenes * k)
        optimizer.zero_grad()
        (-total.mean()).backward()
        nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        training.append(total.mean().item())
        print(f"{k:3d}  reward {training[-1]:.4f}, in the test {tests[-1]:.4f}", flush=True)
    return policy, training, tests


@torch.no_grad()
def draw(policy: nn.Module, training: list[float], tests: list[float], out: Path, device: str) -> float:
    """Pictures of an episode of the test and the rewards over the iterations; returns the mean miss in the test [m]."""
    from matplotlib.figure import Figure

    env = Push(SCENES, render_mode="rgb_array", autoreset_mode="Disabled", max_episode_steps=STEPS, device=device)
    observation, _ = env.reset(seed=TEST)
    frames: list[np.ndarray] = [env.render()[0]]
    for k in range(STEPS):
        observation, *_ = env.step(policy(SCALE * observation))
        if k in (STEPS // 3, STEPS - 1):
            frames.append(env.render()[0])
    env.close()
    figure = Figure(figsize=(9, 5), dpi=100)
    above, below = figure.subplots(2, 1)
    above.imshow(render.contact_sheet(frames, 3))
    above.axis("off")
    below.plot(training, color="C0", alpha=0.5, label="new scenes in each iteration")
    below.plot(tests, color="C1", label="scenes of the test")
    below.set(xlabel="iteration", ylabel="sum of rewards [m]")
    below.legend(loc="lower right")
    figure.tight_layout()
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "learn_push.png")
    return float((observation[:, 2] - observation[:, 6]).abs().mean())


def main(out: Path, device: str = "cpu", iterations: int = 60) -> float:
    """Returns the mean distance of the lumps from the targets at the end of the test [m]."""
    policy, training, tests = train(iterations, device)
    return draw(policy, training, tests, out, device)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/learn_push"), help="folder of the picture")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--iterations", type=int, default=60)
    torch.set_num_threads(1)  # A few hundred particles: more threads would only wait for each other.
    options, begin = parser.parse_args(), time.perf_counter()
    miss = main(options.out, options.device, options.iterations)
    print(f"mean miss {miss:.4f} m in scenes of the test")
    print(f"{time.perf_counter() - begin:.0f} s; see {options.out / 'learn_push.png'}")
