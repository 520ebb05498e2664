"""Locking of nearly incompressible bodies: the report, and its bound against cantilevers."""

import subprocess
import sys
import warnings

import pytest
import torch
from helpers import run_quick_here
from pairs import in_pairs

import torch_mpm as mpm
from benchmarks.accuracy.locking import sag
from torch_mpm.laws.locking import LARGEST, least_bending, problem
from torch_mpm.laws.parameters import PerMaterial


@pytest.mark.filterwarnings("ignore::torch_mpm.LockingWarning")
@pytest.mark.parametrize(
    *in_pairs(
        {("shift", "per_cell"): [(0.0, 4), (0.5, 4), (0.0, 9)]}, kernel=["quadratic", "cubic"], nu=[0.49, 0.499, 0.4999]
    )
)
def test_a_cantilever_bends_by_no_less_than_the_report_has_it(kernel, nu, shift, per_cell):
    share = sag(nu, 4, kernel, per_cell, shift=shift)
    assert least_bending(2 * nu / (1 - 2 * nu), 4, kernel) < share < 1.03


@pytest.mark.filterwarnings("ignore::torch_mpm.LockingWarning")
@pytest.mark.parametrize("kernel", ["quadratic", "cubic"])
def test_bodies_below_the_limit_do_not_lock(kernel):
    ratio = LARGEST[kernel]
    assert sag(ratio / (2 * (1 + ratio)), 4, kernel) > 0.9


def reported(law, kernel="quadratic", device="cpu"):
    """Whether a new step, and its check, report a law."""
    grid = mpm.Grid(0.1, (0.0, 0.0), (1.0, 1.0), kernel=kernel)
    with warnings.catch_warnings(record=True) as new:
        warnings.simplefilter("always")
        step = mpm.Step(grid, law)
    with warnings.catch_warnings(record=True) as checked:
        warnings.simplefilter("always")
        step.check()
    return tuple(any(w.category is mpm.LockingWarning for w in caught) for caught in (new, checked))


MANY = [0.3, 0.499, 0.3]
LAWS = {
    "numbers": (lambda d: mpm.NeoHookean(E=1e5, nu=0.499), True),
    "Lamé": (lambda d: mpm.FixedCorotated(mu=1.0, lam=100.0), True),
    "entries": (lambda d: mpm.Hencky(E=1e5, nu=torch.tensor(MANY, device=d)), True),
    "entries of λ": (lambda d: mpm.Hencky(mu=torch.ones(2, device=d), lam=torch.tensor([1.0, 100.0], device=d)), True),
    "mixture": (lambda d: mpm.Mixture([mpm.Hencky(E=1.0, nu=0.3), mpm.NeoHookean(E=1.0, nu=0.4999)]), True),
    "plastic": (lambda d: mpm.VonMises(E=1e5, nu=0.4999, yield_stress=1.0), True),
    "materials": (lambda d: mpm.Hencky(E=1e5, nu=PerMaterial([0.3, 0.499])), True),
    "trained": (lambda d: mpm.Hencky(E=1e5, nu=torch.nn.Parameter(torch.tensor(0.499, device=d))), True),
    "compressible": (lambda d: mpm.NeoHookean(E=1e5, nu=0.49), False),
    "fluid": (lambda d: mpm.NeoHookean(mu=0.0, lam=1e5), False),
    "water": (lambda d: mpm.WeaklyCompressible(bulk_modulus=1e5), False),
    "of temperature": (lambda d: mpm.NeoHookean(E=lambda t: 1e5 + t, nu=0.3), False),
    "own": (lambda d: lambda F: F - torch.eye(2), False),
}


@pytest.mark.parametrize("name", LAWS)
def test_nearly_incompressible_laws_are_reported(name, device):
    make, locks = LAWS[name]
    read = device == "cpu" or "tensor" not in make.__code__.co_names
    assert reported(make(device)) == (locks and read, locks)


def test_the_kernel_counts():
    assert reported(mpm.NeoHookean(E=1e5, nu=0.4985), "cubic") == (False, False)
    assert reported(mpm.NeoHookean(E=1e5, nu=0.4995), "cubic") == (True, True)


def test_the_report_names_law_and_ratio():
    text = problem(mpm.NeoHookean(E=1e5, nu=0.4999), "quadratic")
    assert text.startswith("NeoHookean with λ/μ = 4999 (ν = 0.4999) is nearly incompressible")
    assert 'kernel="cubic"' in text


@pytest.mark.thorough
def test_commands_report_it_in_one_line(tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text(
        "duration = 0.01\n"
        "grid = { lower = [0, 0], upper = [1, 1], dx = 0.05 }\n"
        'material.a = { law = "neo_hookean", E = 1e4, nu = 0.499 }\n'
        'body = [{ shape = "sphere", center = [0.5, 0.5], radius = 0.2, material = "a" }]\n'
    )
    words = [sys.executable, "-m", "torch_mpm", "check", str(scene)]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert done.stderr.startswith("torch-mpm: warning: NeoHookean with λ/μ = 499") and done.stderr.count("\n") == 1


def test_the_study_runs(tmp_path):
    run_quick_here("benchmarks.accuracy.locking", tmp_path)
    assert "| quadratic | default" in (tmp_path / "locking.md").read_text()
