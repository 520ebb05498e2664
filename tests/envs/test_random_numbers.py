"""Random numbers of scenes beside SplitMix64 in whole numbers of Python, and their independence."""

import torch

from torch_mpm.envs import random_numbers
from torch_mpm.envs.random_numbers import uniform

GAMMA, MASK = 0x9E3779B97F4A7C15, 2**64 - 1


def mixed(bits):
    bits = (bits ^ (bits >> 30)) * 0xBF58476D1CE4E5B9 & MASK
    bits = (bits ^ (bits >> 27)) * 0x94D049BB133111EB & MASK
    return bits ^ (bits >> 31)


def test_the_generator_is_splitmix64(device):
    """The first numbers of the seed 1234567, as in the Java program of the authors."""
    expected = [6457827717110365317, 3203168211198807973, 9817491932198370423]
    assert [mixed(1234567 + k * GAMMA & MASK) for k in (1, 2, 3)] == expected
    states = 1234567 + random_numbers.GAMMA * torch.tensor([1, 2, 3], device=device)
    assert [value % 2**64 for value in random_numbers._mixed(states).tolist()] == expected


def test_numbers_are_those_of_whole_numbers(device):
    seeds, episodes = torch.tensor([0, 5, 2**40], device=device), torch.tensor([0, 3, 1], device=device)
    found = uniform(seeds, episodes, 4)
    for row, seed, episode in zip(found.tolist(), seeds.tolist(), episodes.tolist(), strict=True):
        own = mixed(seed + GAMMA * (episode + 1) & MASK)
        assert row == [(mixed(own + GAMMA * (k + 1) & MASK) >> 11) / 2**53 for k in range(4)]


def test_numbers_are_uniform_and_independent():
    """Of consecutive seeds, of consecutive episodes of one seed, and of the columns."""
    count = torch.arange(20000)
    of_seeds, of_episodes = uniform(count, 0 * count, 2), uniform(0 * count + 7, count, 2)
    for values in (of_seeds, of_episodes):
        assert float(values.min()) >= 0 and float(values.max()) < 1
        counts = torch.histc(values[:, 0], 20, 0, 1)
        assert float(((counts - 1000).square() / 1000).sum()) < 43.8  # chi² of 19 degrees of freedom, 0.001
        pairs = torch.stack([values[:-1, 0], values[1:, 0], values[:-1, 1]])
        assert float((torch.corrcoef(pairs) - torch.eye(3, dtype=torch.float64)).abs().max()) < 0.03
    assert uniform(count, count, 0).shape == (20000, 0)
