"""The package gymnasium, of the extra `envs`."""

from .. import optional

gymnasium = optional.load("gymnasium", "environments", "envs")
vector = optional.load("gymnasium.vector", "environments", "envs")
AutoresetMode = vector.AutoresetMode
