"""The steps of other simulators once more, in NumPy and float64 on a dense grid, from their published behaviour."""

import numpy as np

EYE = np.eye(3)


class Weights:
    """Quadratic B-splines of particles on nodes at multiples of dx: weights, gradients, arms and flat node numbers."""

    def __init__(self, x, dx, n):
        base = (x / dx - 0.5).astype(int)
        f = x / dx - base
        w = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])  # [3, P, 3]
        d = np.stack([f - 1.5, -2 * (f - 1), f - 0.5]) / dx
        self.weight, self.gradient, self.arm, self.node = [], [], [], []
        for i, j, k in np.ndindex(3, 3, 3):
            self.weight.append(w[i, :, 0] * w[j, :, 1] * w[k, :, 2])
            self.gradient.append(
                np.stack(
                    [
                        d[i, :, 0] * w[j, :, 1] * w[k, :, 2],
                        w[i, :, 0] * d[j, :, 1] * w[k, :, 2],
                        w[i, :, 0] * w[j, :, 1] * d[k, :, 2],
                    ],
                    1,
                )
            )
            self.arm.append((np.array([i, j, k]) - f) * dx)
            at = base + [i, j, k]
            self.node.append((at[:, 0] * n + at[:, 1]) * n + at[:, 2])

    def __iter__(self):
        return zip(self.weight, self.gradient, self.arm, self.node, strict=True)


def to_grid(weights, n, mass, v, C, volume, stress, dt, moving_least_squares, dx):
    """Mass [n³] and momentum [n³, 3] with the impulse of the stress."""
    m, mv = np.zeros(n**3), np.zeros((n**3, 3))
    for w, dw, r, node in weights:
        if moving_least_squares:
            force = -volume[:, None] * 4 / dx**2 * w[:, None] * np.einsum("pij,pj->pi", stress, r)
        else:
            force = -volume[:, None] * np.einsum("pij,pj->pi", stress, dw)
        np.add.at(m, node, w * mass)
        np.add.at(mv, node, (w * mass)[:, None] * (v + np.einsum("pij,pj->pi", C, r)) + dt * force)
    return m, mv


def from_grid(weights, grid_v, dx):
    """v, C and ∇v of the particles."""
    v, C, grad = 0, 0, 0
    for w, dw, r, node in weights:
        u = grid_v[node]
        v = v + w[:, None] * u
        C = C + 4 / dx**2 * w[:, None, None] * u[:, :, None] * r[:, None, :]
        grad = grad + u[:, :, None] * dw[:, None, :]
    return v, C, grad


def nodes_of(n, dx):
    """Positions of the nodes [n³, 3]."""
    axis = np.arange(n) * dx
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def rotations_svd(F):
    """F = U diag(s) Vᵀ with rotations; the last singular value has the sign of det F."""
    U, s, Vh = np.linalg.svd(F)
    for turned in (U.transpose(0, 2, 1), Vh):  # rows are the axes; views of U and Vh
        sign = np.sign(np.linalg.det(turned))
        turned[:, 2] *= sign[:, None]
        s[:, 2] *= sign
    return U, s, Vh


def times(U, s, W):
    return (U * s[:, None, :]) @ W


# ---- constitutive models


def lame(E, nu):
    return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))


def corotated(F, mu, lam):
    U, _, Vh = rotations_svd(F)
    J = np.linalg.det(F)
    return 2 * mu * (F - U @ Vh) @ F.transpose(0, 2, 1) + (lam * J * (J - 1))[:, None, None] * EYE
