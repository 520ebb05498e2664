"""The matrices that the benchmarks of the heat solve compare with, and their errors."""

import torch

from benchmarks.speed.heat import Problem, csr, csr_cg
from benchmarks.stability.heat import assembled, case
from torch_mpm.ops import heat_operator


def test_assembled_matrices_are_the_operator():
    p = Problem(4, "cpu")
    u = torch.rand_like(p.theta)
    expected = heat_operator(p.blocks, p.x, p.conductance, u)
    some = p.heat_capacity > 0
    torch.testing.assert_close(csr(p) @ u[some], expected[some], rtol=1e-4, atol=1e-7)
    assert (expected[~some] == 0).all()
    product = assembled(p.blocks, p.x, p.conductance) @ u.double().numpy()
    torch.testing.assert_close(torch.from_numpy(product).float(), expected, rtol=1e-4, atol=1e-7)


def test_conjugate_gradients_of_the_peer():
    p = Problem(4, "cpu")
    H = csr(p)
    some = p.heat_capacity > 0
    diagonal = heat_operator(p.blocks, p.x, p.conductance, None)[some]
    peer = csr_cg(H, p.heat_capacity[some] / p.dx**2, diagonal, -(H @ p.theta[some]), 30)
    torch.testing.assert_close(p.solve(1.0, tolerance=1e-7).increment[some], peer, rtol=1e-3, atol=1e-5)


def test_case_of_the_stability_table():
    row = case(8, 1.0, 1e3, "cg", torch.float64, False)
    assert row["converged"] and row["error"] < 1e-8 and 5 < row["iterations"] < 40
    row = case(8, 1e4, 1e3, "multigrid", torch.float32, True)
    assert row["converged"] and row["error"] < 1e-8 and row["iterations"] < 40
