"""NCLaw's laws: modules F -> stress and F -> F after plastic flow, and the networks that learn them.

The argument of each is a configuration, an object or a mapping with its parameters. Stress is P Fᵀ, the Kirchhoff
stress [Pa].
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ...ops.svd import polar, svd3
from .. import constitutive
from ..gradients import number
from ..settings import setting
from .warp import SVD


def _single(cfg: Any, name: str) -> Tensor:
    """A number of a configuration [1]."""
    return torch.tensor([number(name, setting(cfg, name))])


class Material(nn.Module):
    """A law of a configuration.

    Args:
        cfg: its parameters; None for none.
    """

    def __init__(self, cfg: Any = None) -> None:
        super().__init__()
        self.dim = 3
        self.svd = SVD()

    def transpose(self, F: Tensor) -> Tensor:
        """Transpose of matrices [P, 3, 3]."""
        return F.mT

    def forward(self, F: Tensor) -> Tensor:
        """Of F [P, 3, 3]."""
        raise NotImplementedError


class Elasticity(Material):
    """F [P, 3, 3] -> stress [P, 3, 3] [Pa]."""


class Plasticity(Material):
    """F [P, 3, 3] -> F after plastic flow."""


class ComposeMaterial(Material):
    """Several laws, each for the particles of one section.

    Args:
        materials: the laws.
        sections: numbers of particles, in the order of the particles.
    """

    def __init__(self, materials: Sequence[nn.Module], sections: Sequence[int]) -> None:
        super().__init__()
        self.materials = nn.ModuleList(materials)
        self.sections = sections

    def update_sections(self, sections: Sequence[int]) -> None:
        """Set the numbers of particles."""
        self.sections = sections

    def forward(self, F: Tensor) -> Tensor:
        parts = zip(self.materials, torch.split(F, list(self.sections)), strict=True)
        return torch.cat([law(part) for law, part in parts])


# ---- laws with known form


class _Moduli(Material):
    """A law with the parameter `log_E` and the buffer `nu`, [1] each; `random` starts at another log E."""

    nu: Tensor

    def __init__(self, cfg: Any) -> None:
        super().__init__(cfg)
        self.log_E = nn.Parameter(self._started(_single(cfg, "E").log(), cfg))
        self.register_buffer("nu", _single(cfg, "nu"))

    @staticmethod
    def _started(value: Tensor, cfg: Any) -> Tensor:
        return 0.8 * value if setting(cfg, "random", False) else value

    def moduli(self) -> tuple[Tensor, Tensor]:
        """μ and λ [Pa], [1]."""
        return constitutive.lame(self.log_E.exp(), self.nu)


class CorotatedElasticity(_Moduli, Elasticity):
    """2 μ (F − R) Fᵀ + λ J (J − 1). Configuration: E [Pa], nu, random."""

    def forward(self, F: Tensor) -> Tensor:
        return constitutive.corotated(F, *self.moduli())


class StVKElasticity(_Moduli, Elasticity):
    """μ F (Fᵀ F − 1) + λ J (J − 1), as in NCLaw. Configuration: E [Pa], nu, random."""

    def forward(self, F: Tensor) -> Tensor:
        return constitutive.stvk(F, *self.moduli())


class VolumeElasticity(_Moduli, Elasticity):
    """λ J (J − 1), or K (J − 1/J). Configuration: E [Pa], nu, random, mode ("taichi" or "ziran")."""

    def __init__(self, cfg: Any) -> None:
        super().__init__(cfg)
        self.mode = str(setting(cfg, "mode")).casefold()
        if self.mode not in ("taichi", "ziran"):
            raise ValueError(f"mode must be 'taichi' or 'ziran', got {self.mode!r}")

    def forward(self, F: Tensor) -> Tensor:
        mu, lam = self.moduli()
        return constitutive.volume(F, lam) if self.mode == "taichi" else constitutive.equation_of_state(F, mu, lam)


class SigmaElasticity(_Moduli, Elasticity):
    """The quadratic energy of the logarithms of the stretches. Configuration: E [Pa], nu, random."""

    def forward(self, F: Tensor) -> Tensor:
        return constitutive.hencky(F, *self.moduli())


class IdentityPlasticity(Plasticity):
    """No plastic flow."""

    def forward(self, F: Tensor) -> Tensor:
        return F


class SigmaPlasticity(Plasticity):
    """Fluid: J^(1/3) 1."""

    def forward(self, F: Tensor) -> Tensor:
        return constitutive.isochoric_reset(F)


class VonMisesPlasticity(_Moduli, Plasticity):
    """|dev 2 μ ε| ≤ σ_y. Configuration: E [Pa], nu, sigma_y [Pa], random."""

    def __init__(self, cfg: Any) -> None:
        super().__init__(cfg)
        self.sigma_y = nn.Parameter(self._started(_single(cfg, "sigma_y"), cfg))

    def forward(self, F: Tensor) -> Tensor:
        return constitutive.von_mises(F, self.moduli()[0], self.sigma_y)


class DruckerPragerPlasticity(_Moduli, Plasticity):
    """Dry sand (Klár et al. 2016). Configuration: E [Pa], nu, friction_angle [degrees], cohesion (strain), random."""

    cohesion: Tensor

    def __init__(self, cfg: Any) -> None:
        super().__init__(cfg)
        self.friction_angle = nn.Parameter(self._started(_single(cfg, "friction_angle"), cfg))
        self.register_buffer("cohesion", _single(cfg, "cohesion"))

    def forward(self, F: Tensor) -> Tensor:
        return constitutive.drucker_prager(F, *self.moduli(), self.friction_angle, self.cohesion)


# ---- networks


class MLPBlock(nn.Module):
    """A linear layer, a norm and a nonlinearity; names of parameters are NCLaw's, so that its checkpoints load."""

    def __init__(self, width: int, next_width: int, no_bias: bool, norm: str | None, nonlinearity: str | None) -> None:
        super().__init__()
        self.fc = nn.Linear(width, next_width, bias=not no_bias and norm is None)
        self.norm = _chosen("norm", norm, NORMS)(next_width, not no_bias)
        self.nonlinearity = _chosen("nonlinearity", nonlinearity, NONLINEARITIES)()

    def forward(self, x: Tensor) -> Tensor:
        return self.nonlinearity(self.norm(self.fc(x)))


NORMS: dict[str | None, Callable[[int, bool], nn.Module]] = {
    None: lambda width, affine: nn.Identity(),
    "ln": lambda width, affine: nn.LayerNorm(width, elementwise_affine=affine),
    "bn": lambda width, affine: nn.BatchNorm1d(width, affine=affine),
}
NONLINEARITIES: dict[str | None, Callable[[], nn.Module]] = {
    **{None: nn.Identity, "relu": nn.ReLU, "tanh": nn.Tanh, "silu": nn.SiLU, "swish": nn.SiLU},
    **{"gelu": nn.GELU, "elu": nn.ELU},
}


def _chosen(name: str, given: str | None, choices: dict[Any, Any]) -> Any:
    key = given.casefold() if isinstance(given, str) else given
    if key not in choices:
        raise ValueError(f"{name} must be one of {list(choices)}, got {given!r}")
    return choices[key]


class _Network(Material):
    """A network from features of F to a matrix M [P, 3, 3].

    Configuration: layer_widths, no_bias, norm, nonlinearity, normalize_input.
    """

    features = 0
    rotated = True

    def __init__(self, cfg: Any) -> None:
        super().__init__(cfg)
        self.normalize_input = bool(setting(cfg, "normalize_input", True))
        no_bias, norm, nonlinearity = (setting(cfg, name) for name in ("no_bias", "norm", "nonlinearity"))
        widths = [self.features, *setting(cfg, "layer_widths")]
        blocks = [MLPBlock(a, b, no_bias, norm, nonlinearity) for a, b in itertools.pairwise(widths)]
        self.layers = nn.ModuleList(blocks)
        self.final_layer = MLPBlock(widths[-1], 9, no_bias, None, None)
        for part in self.modules():
            if isinstance(part, nn.Linear):
                nn.init.xavier_uniform_(part.weight)
                if part.bias is not None:
                    nn.init.zeros_(part.bias)

    def inputs(self, F: Tensor) -> Tensor:
        """Features [P, features]."""
        raise NotImplementedError

    def output(self, F: Tensor) -> Tensor:
        """M of the network, or R sym M."""
        x = self.inputs(F)
        for layer in self.layers:
            x = layer(x)
        M = self.final_layer(x).unflatten(1, (3, 3))
        return polar(F).R.to(M.dtype) @ ((M + M.mT) / 2) if self.rotated else M

    def less(self, value: Tensor, rest: float | Tensor) -> Tensor:
        """A feature minus its value at rest, where inputs are normalised."""
        return value - rest if self.normalize_input else value


class _Plain(_Network):
    """Features: F."""

    features, rotated = 9, False

    def inputs(self, F: Tensor) -> Tensor:
        return self.less(F, constitutive.identity(F)).flatten(1)


class _Polar(_Network):
    """Features: S of F = R S."""

    features = 9

    def inputs(self, F: Tensor) -> Tensor:
        return self.less(polar(F).S, constitutive.identity(F)).flatten(1)


class _Invariant(_Network):
    """Features: Σ σ, tr FᵀF and det F."""

    features = 3

    def inputs(self, F: Tensor) -> Tensor:
        first, second = svd3(F).sigma.sum(1), F.square().sum((1, 2))
        third = torch.linalg.det(F)
        return torch.stack([self.less(first, 3.0), self.less(second, 1.0), self.less(third, 1.0)], 1)


class _InvariantFull(_Network):
    """Features: σ, FᵀF and det F."""

    features = 13

    def inputs(self, F: Tensor) -> Tensor:
        stretch = self.less(F.mT @ F, constitutive.identity(F)).flatten(1)
        det = self.less(torch.linalg.det(F), 1.0)[:, None]
        return torch.cat([self.less(svd3(F).sigma, 1.0), stretch, det], 1)


class _NetworkElasticity(_Network, Elasticity):
    """Stress R sym M Fᵀ, or M Fᵀ of plain features."""

    def forward(self, F: Tensor) -> Tensor:
        return self.output(F) @ F.mT


class _NetworkPlasticity(_Network, Plasticity):
    """F + α R sym M, or F + α M of plain features. Configuration: also alpha."""

    def __init__(self, cfg: Any) -> None:
        super().__init__(cfg)
        self.alpha = number("alpha", setting(cfg, "alpha"))

    def forward(self, F: Tensor) -> Tensor:
        return F + self.alpha * self.output(F)


class PlainMetaElasticity(_Plain, _NetworkElasticity):
    """A network of F."""


class PolarMetaElasticity(_Polar, _NetworkElasticity):
    """A network of S, rotated by R."""


class InvariantMetaElasticity(_Invariant, _NetworkElasticity):
    """A network of three invariants, rotated by R."""


class InvariantFullMetaElasticity(_InvariantFull, _NetworkElasticity):
    """A network of σ, FᵀF and det F, rotated by R: that of the paper."""


class PlainMetaPlasticity(_Plain, _NetworkPlasticity):
    """A network of F."""


class PolarMetaPlasticity(_Polar, _NetworkPlasticity):
    """A network of S, rotated by R."""


class InvariantFullMetaPlasticity(_InvariantFull, _NetworkPlasticity):
    """A network of σ, FᵀF and det F, rotated by R: that of the paper. Its inputs are always normalised."""

    def __init__(self, cfg: Any) -> None:
        super().__init__(cfg)
        self.normalize_input = True


class _Unavailable(Material):
    """A law of NCLaw that is not available: it is not symmetric in the stretches, and has no gradient at F = I.

    Raises:
        NotImplementedError: always.
    """

    def __init__(self, cfg: Any = None) -> None:
        raise NotImplementedError(
            f"{type(self).__name__} has no gradient where two stretches are equal, as at F = I, since its function is "
            "not symmetric in them: use InvariantFull networks, or torch_mpm.isotropic with a symmetric network"
        )


class SVDMetaElasticity(_Unavailable):
    """A network of σ in the axes of the singular vectors, which raises."""


class SplineMetaElasticity(_Unavailable):
    """Splines of the stretches, of areas and of the volume, which raise."""


class SVDMetaPlasticity(_Unavailable):
    """A network of σ in the axes of the singular vectors, which raises."""


class SplineMetaPlasticity(_Unavailable):
    """Splines of the stretches, of areas and of the volume, which raise."""
