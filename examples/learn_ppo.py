"""Train a network for a task of `torch_mpm.envs` by PPO of stable-baselines3, and test it on new scenes.

PPO uses the rewards only. The returns, the sums of the rewards of an episode, are printed beside those of the untrained
network and of the plan by gradients through the simulation (`plan_tasks`). Needs `pip install "torch-mpm[learn]"`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from plan_tasks import GUESSES, improve
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from torch import Tensor, nn

from torch_mpm import envs
from torch_mpm.data.whole_files import replacing
from torch_mpm.envs.stable_baselines import StableBaselinesEnv


class Training(NamedTuple):
    """Steps of the environment, in all scenes together; number of scenes; steps of each scene before an update, how
    often the update uses each of them, and in how many batches; rate of learning at the beginning, which falls to zero;
    discount of a step; and logarithm of the standard deviation of the actions at the beginning."""

    steps: int
    scenes: int = 16
    steps_per_update: int = 20
    epochs: int = 10
    batches: int = 4
    learning_rate: float = 1e-3
    discount: float = 0.98
    log_deviation: float = -0.5


TRAININGS = {
    "push": Training(40_000),
    "roll": Training(30_000),
    "pour": Training(80_000, learning_rate=5e-4, discount=0.99, log_deviation=-1.5),
    "scoop": Training(20_000, epochs=20),
    "lift": Training(30_000),
    "write": Training(600_000, 256, batches=8),
}
TEST = 10**6  # seed of the first scene of the test
HIDDEN = 64  # neurons of both hidden layers, as in the networks of stable-baselines3


class Episode(NamedTuple):
    """Sums of the rewards of an episode in each scene [B], and whether it ended with success, bool [B]."""

    returns: Tensor
    success: Tensor


class Result(NamedTuple):
    """The network; steps of the environment; steps and mean return of each update; episodes that failed; the test
    before and after."""

    policy: nn.Module
    steps: int
    curve: list[tuple[int, float]]
    failed: int
    before: Episode
    after: Episode


class Standardize(nn.Module):
    """Observations minus their mean, over their standard deviation, at most 10: those of `VecNormalize`."""

    def __init__(self, numbers: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(numbers))
        self.register_buffer("deviation", torch.ones(numbers))

    def forward(self, observation: Tensor) -> Tensor:
        return ((observation - self.mean) / self.deviation).clamp(-10.0, 10.0)


def network(name: str) -> nn.Sequential:
    """Actions by observations of a task, without the noise of the training."""
    task: Any = GUESSES[name].task
    hidden = (nn.Linear(task.OBSERVATIONS, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, HIDDEN), nn.Tanh())
    return nn.Sequential(Standardize(task.OBSERVATIONS), nn.Sequential(*hidden, nn.Linear(HIDDEN, task.ACTIONS)))


def network_of(model: PPO, name: str) -> nn.Sequential:
    """A copy of the network of a model of stable-baselines3, with the statistics of its observations."""
    policy, env = network(name), model.get_env()
    policy[0].mean.copy_(torch.as_tensor(env.obs_rms.mean))
    policy[0].deviation.copy_(torch.as_tensor(env.obs_rms.var + env.epsilon).sqrt())
    trained = nn.Sequential(*model.policy.mlp_extractor.policy_net, model.policy.action_net)
    policy[1].load_state_dict(trained.state_dict())
    return policy


def save(policy: nn.Module, path: Path) -> None:
    """Write the tensors of a network as a file of `torch.save`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as incomplete:
        torch.save(policy.state_dict(), incomplete)


def load(name: str, path: Path) -> nn.Sequential:
    """The network of a task from a file of `save`, which is read as tensors only."""
    policy = network(name)
    policy.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    return policy


def make_env(name: str, scenes: int, device: str, **options: Any) -> envs.MaterialEnv:
    guess = GUESSES[name]
    return guess.task(scenes, guess.dx, autoreset_mode="Disabled", device=device, **options)


@torch.no_grad()
def episode(env: envs.MaterialEnv, policy: nn.Module, seed: int) -> Episode:
    observation, _ = env.reset(seed=seed)
    total, success = torch.zeros(env.num_envs, device=env.device), torch.zeros_like(env.ended)
    while not env.ended.all():
        observation, reward, _, _, info = env.step(policy(observation))
        total, success = total + reward, success | info["success"]
    return Episode(total.cpu(), success.cpu())


class Curve(BaseCallback):
    """Mean return of the episodes that ended since the update before, at each update where one has, and failures.

    The first episodes of the scenes end early, one after another, so that later an update has steps from all times of
    an episode. They do not count.
    """

    def __init__(self) -> None:
        super().__init__()
        self.points: list[tuple[int, float]] = []
        self.failed = 0
        self._ended: list[float] = []
        self._scenes: set[int] = set()  # whose first episode has ended

    def _on_training_start(self) -> None:
        env = self.training_env.unwrapped.env
        b = torch.arange(env.num_envs, device=env.device)
        env.steps = env.steps + b * env.max_episode_steps // env.num_envs

    def _on_step(self) -> bool:
        ended = {b: info["episode"]["r"] for b, info in enumerate(self.locals["infos"]) if "episode" in info}
        self._ended += [float(value) for b, value in ended.items() if b in self._scenes]
        self._scenes.update(ended)
        self.failed += sum("reason" in info for info in self.locals["infos"])
        return True

    def _on_rollout_end(self) -> None:
        if self._ended:
            self.points.append((self.num_timesteps, sum(self._ended) / len(self._ended)))
            self._ended = []
            print(f"{self.points[-1][0]:8d} steps, return {self.points[-1][1]:.4f}", flush=True)


def make_model(name: str, training: Training, seed: int, device: str) -> PPO:
    env = StableBaselinesEnv(make_env(name, training.scenes, device, numpy=True))
    return PPO(
        "MlpPolicy",
        VecNormalize(VecMonitor(env), gamma=training.discount),
        learning_rate=lambda left: training.learning_rate * left,
        n_steps=training.steps_per_update,
        batch_size=training.scenes * training.steps_per_update // training.batches,
        n_epochs=training.epochs,
        gamma=training.discount,
        policy_kwargs={"net_arch": [HIDDEN, HIDDEN], "log_std_init": training.log_deviation},
        seed=seed,
        device="cpu",  # The network is small.
    )


def train(name: str, training: Training, seed: int = 0, device: str = "cpu") -> Result:
    """Train a network for a task; the training and the test have the same number of scenes."""
    model, curve = make_model(name, training, seed, device), Curve()
    test = make_env(name, training.scenes, device)
    before = episode(test, network_of(model, name).to(device), TEST)
    model.learn(training.steps, curve)
    policy = network_of(model, name).to(device)
    after = episode(test, policy, TEST)
    return Result(policy, model.num_timesteps, curve.points, curve.failed, before, after)


def beside_the_plan(name: str, policy: nn.Module, device: str) -> tuple[float, float, float]:
    """Returns of the network, and of the first and the best plan by gradients, in the scene of this plan."""
    _, rewards = improve(GUESSES[name], device)
    return float(episode(make_env(name, 1, device), policy, 0).returns), rewards[0], max(rewards)


def plot(axes: Any, result: Result) -> None:
    """The curve of a training, and the mean returns in the test as lines."""
    axes.plot(*zip(*result.curve, strict=True), color="C0", label="training")
    axes.axhline(result.before.returns.mean(), color="C7", linestyle="--", label="test, untrained")
    axes.axhline(result.after.returns.mean(), color="C1", linestyle="--", label="test, trained")


def draw(name: str, result: Result, path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), dpi=100)
    axes = figure.subplots()
    plot(axes, result)
    axes.set(title=name, xlabel="steps of the environment", ylabel="return")
    axes.legend(loc="lower right")
    figure.tight_layout()
    figure.savefig(path)


def main(name: str, out: Path, training: Training, seed: int = 0, device: str = "cpu") -> Result:
    result = train(name, training, seed, device)
    save(result.policy, out / f"{name}.pt")
    draw(name, result, out / f"{name}.png")
    before, after = (test.returns.mean() for test in (result.before, result.after))
    print(f"{name}: return {before:.4f} of the untrained network in the test, {after:.4f} of the trained one")
    trained, first, best = beside_the_plan(name, result.policy, device)
    print(f"in scene 0: return {trained:.4f} of the network, {first:.4f} of the first plan, {best:.4f} by gradients")
    return result


def arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=TRAININGS)
    parser.add_argument("--steps", type=int, help="of the environment, in all scenes together")
    parser.add_argument("--scenes", type=int, help="of the training and of the test")
    parser.add_argument("--seed", type=int, default=0, help="of the first scene and of PPO")
    parser.add_argument("--out", type=Path, default=Path("out/learn_ppo"), help="folder of the network and the curve")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu", help="of the simulation")
    return parser.parse_args(given)


if __name__ == "__main__":
    torch.set_num_threads(1)  # A few thousand particles: more threads would only wait for each other.
    options, begin = arguments(), time.perf_counter()
    chosen = {key: getattr(options, key) for key in ("steps", "scenes") if getattr(options, key) is not None}
    main(options.task, options.out, TRAININGS[options.task]._replace(**chosen), options.seed, options.device)
    print(f"{time.perf_counter() - begin:.0f} s; see {options.out / options.task}.png")
