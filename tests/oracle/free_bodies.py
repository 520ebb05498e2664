"""A step of free bodies, whose velocities Newton's method finds in torch, with derivatives by autograd.

The equations and the end of the step are those of `torch_mpm.bodies.solution`, of ops that have oracles of their own.
The iterations, the scale of the residual and its derivative are here.
"""

import torch

from torch_mpm.bodies.solution import MAX_ITERATIONS, TOLERANCE, Solution


def steps(bodies, state, rows, n, dt, wrenches=None):
    """State, rows and report [B, 1 + K] after n steps."""
    now, report = rows.double(), torch.zeros(len(rows), 1 + rows.shape[1], dtype=torch.float64, device=rows.device)
    for _ in range(n):
        hook = InTorch(bodies, now, dt, wrenches)
        bodies.step.on_grid = hook
        with torch.no_grad():
            state = bodies.step(state, dt)
        bodies.step.on_grid = None
        now, report = hook.rows, torch.maximum(report, hook.report)
    return state, now, report


class InTorch(Solution):
    """All scenes iterate until each has converged."""

    def _solved(self, blocks, contact):
        U, dtype, iterations = self.predicted, contact.velocity.dtype, 0
        residual = self.residual_of(contact, U)
        size = self.size_of(residual)
        scale = self.size_of(self.predicted) + size + torch.finfo(U.dtype).tiny
        share = torch.ones_like(scale[:, 0])
        jacobian = self.derivative(contact, U)
        eye = torch.eye(jacobian.shape[1], dtype=U.dtype, device=U.device)
        while iterations < MAX_ITERATIONS and not (size <= 0.1 * TOLERANCE[dtype] * scale).all():
            iterations += 1
            # Velocities are rounded to the dtype of the nodes, whose impulses change accordingly.
            rounded = torch.finfo(dtype).eps * (jacobian - eye).norm(dim=(1, 2))
            scale = torch.maximum(scale, (rounded[:, None] * self.size_of(U)) / TOLERANCE[dtype])
            step = torch.linalg.solve(jacobian, residual.flatten(1)).view_as(U)
            trial = U - share[:, None, None] * step
            better = self.size_of(self.residual_of(contact, trial)).norm(dim=1) < size.norm(dim=1)
            share = torch.where(better, 1.0, 0.5 * share)
            U = torch.where(better[:, None, None], trial, U)
            residual, jacobian = self.residual_of(contact, U), self.derivative(contact, U)
            size = self.size_of(residual)
        self.report = torch.cat([torch.full_like(scale[:, :1], iterations), size / scale], 1)
        return U, jacobian

    def residual_of(self, contact, U):
        return U - self.predicted - self._applied(contact.impulses(U))

    def derivative(self, contact, U):
        """Of the residuals of all bodies of a scene by all velocities [B, K n, K n]."""
        with torch.enable_grad():
            leaf = U.detach().requires_grad_()
            sums = self.residual_of(contact, leaf).sum(0).flatten().unbind()
        return torch.stack([torch.autograd.grad(one, leaf, retain_graph=True)[0].flatten(1) for one in sums], 1)

    def size_of(self, velocities):
        """Speeds [B, K] of velocities [B, K, n]; of rotation that at the radius of gyration."""
        inertia = self.mass.diagonal(dim1=2, dim2=3)[..., self.dim :].mean(2)
        squared = velocities[..., : self.dim].square().sum(2)
        spin = velocities[..., self.dim :].square().sum(2)
        return (squared + spin * inertia / self.mass[..., 0, 0]).sqrt()
