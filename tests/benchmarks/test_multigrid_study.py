"""The study of multigrid: its matrices are those of the library, and its preconditioners are symmetric and solve."""

from unittest import mock

import numpy as np
import pytest
import torch
from scipy.sparse.linalg import spsolve

from benchmarks.implicit.multigrid import NAMES, Case, Work, counts, first_system
from benchmarks.implicit.preconditioners import assembled, iterations, preconditioner
from torch_mpm.implicit import quadratic_model
from torch_mpm.ops import implicit_apply


@pytest.fixture(scope="module")
def system():
    return first_system(Case("beam", 2, 24))


@pytest.mark.parametrize("case", [Case("block", 2, 6), Case("ball", 3, 4)])
def test_assembled_matrix(case):
    seen = []

    def keep(*arguments, **rest):
        blocks, x, rhs, mass, _, tangent, *_ = arguments
        s = assembled(*arguments[:6])
        direction = torch.zeros_like(rhs)
        values = torch.randn(len(s.b), dtype=torch.float64)
        rows, columns = torch.nonzero(mass > 0)[s.node, 0], torch.from_numpy(s.component)
        direction[rows, columns] = values
        product = implicit_apply(blocks, x, direction, tangent, mass)[rows, columns]
        torch.testing.assert_close(torch.from_numpy(s.A @ values.numpy()), product, rtol=1e-12, atol=1e-12)
        seen.append(s)
        raise InterruptedError

    step, state, dt = case.made()
    with mock.patch.object(quadratic_model, "implicit_cg", keep), torch.no_grad(), pytest.raises(InterruptedError):
        step(state, dt)
    assert len(seen[0].b) < len(seen[0].lattice) * case.dim  # some are held


def test_steps_with_node_blocks_are_those_of_the_library():
    step, state, dt = Case("block", 2, 8).made()
    with torch.no_grad():
        own = step(state, dt).x
        work = Work("blocks")
        with mock.patch.object(quadratic_model, "implicit_cg", work):
            other = step(state, dt).x
    torch.testing.assert_close(other - state.x, own - state.x, rtol=1e-6, atol=1e-15)
    step(state, dt)
    assert abs(int(step.solve_report.cg_iterations) - work.iterations) <= 2  # rounding may take one more


@pytest.mark.parametrize("name", NAMES)
def test_preconditioners_are_symmetric_and_solve(system, name):
    p = preconditioner(system, name)
    a, b = np.random.default_rng(1).standard_normal((2, len(system.b)))
    # Residuals of unknowns differ in size: those of velocities of the same energy.
    a, b = system.A @ a, system.A @ b
    assert a @ p.apply(a) > 0
    assert abs(a @ p.apply(b) - b @ p.apply(a)) < 1e-9 * abs(a @ p.apply(a))
    goal = 1e-9 * np.sqrt(system.b @ (system.inverse @ system.b))
    error = next(x for x, size in iterations(system, p) if size < goal) - spsolve(system.A.tocsc(), system.b)
    assert error @ (system.A @ error) < 1e-12 * (system.b @ spsolve(system.A.tocsc(), system.b))


def test_multigrid_needs_fewer_iterations(system):
    found = {name: counts(system, preconditioner(system, name)) for name in NAMES}
    assert found["V(2, 2)"][1e-4] < found["additive"][1e-4] < found["blocks"][1e-4] / 1.5
    assert found["patches"][1e-8] < found["blocks"][1e-8]
