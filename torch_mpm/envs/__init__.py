"""Environments that learn: tasks with materials in gymnasium's vector interface (docs/envs.md); extra `envs`.

env = gymnasium.make_vec("torch_mpm.envs:torch_mpm/Push-v0", num_envs=64)  # or envs.Push(64)
observations, info = env.reset(seed=0)
for _ in range(steps):
    observations, rewards, terminated, truncated, info = env.step(policy(observations))
"""

from .lift import Lift
from .package import gymnasium
from .pour import Pour
from .push import Push
from .roll import Roll
from .scoop import Scoop
from .vector import MaterialEnv, Scenes
from .write import Write

__all__ = ["Lift", "MaterialEnv", "Pour", "Push", "Roll", "Scenes", "Scoop", "Write"]

TASKS: tuple[type[MaterialEnv], ...] = (Push, Roll, Pour, Scoop, Lift, Write)

for task in TASKS:
    gymnasium.register(
        f"torch_mpm/{task.__name__}-v0",
        vector_entry_point=f"{task.__module__}:{task.__name__}",
        max_episode_steps=task.MAX_EPISODE_STEPS,
    )
