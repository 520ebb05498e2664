"""Laws of csrc/laws: their parameters in all accepted forms, and their call.

Parameters are numbers or tensors of shape [], [1], [B] (per scene) or [P] (per particle, in the order of `state.ids`
where particles were reordered; also where P = B), and gradients pass to them. A parameter may also be a function of
temperature, [P] -> [P] (`Table`, an `nn.Module`, any torch code), evaluated at state.temperature.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from numbers import Real
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor, nn

from ..cuda_graphs.capture import DeviceConstantCache, is_traced
from ..errors import check_number, shape_of
from ..geometry.vectors import product
from ..ops.arguments import refuse_batched, soa_empty
from ..ops.implicit import add_deviator
from ..ops.law import (
    DISSIPATED,
    LawUpdate,
    law_energy,
    law_energy_gradient,
    law_stiffness,
    law_tangent,
    law_update,
    law_wave_modulus,
    option_bits,
)
from ..ops.registry import LAWS
from .flowing import flowing_skew, flowing_stress, flowing_tangent
from .material import Material
from .parameters import Overlay, PerMaterial, Value, check_length, evaluate, needs_no_scenes

if TYPE_CHECKING:
    from ..state.state import State


PLASTIC_VOLUME = "log_plastic_volume"
"""History of laws whose plastic flow changes the volume: ln J_p."""
ARGUMENTS = {"eta": "viscosity"}
"""Names of arguments that are stored under another name."""
Range = tuple[str, Callable[[Any], Any]]
"""Range of a parameter: in words, and a test of a number or of each entry of a tensor."""
_NO_VALUES = frozenset({type(value) for value in vars(nn.Module()).values()} | {DeviceConstantCache, str})
"""Types of attributes that are no parameters, such as those that every module has."""
FIGURES = ("stress", "stiffness", "energy_density")
"""Values of a law that a survey needs."""


class CompiledLaw(Material):
    """A law of csrc/laws; subclasses name it, and convert their arguments to its parameters.

    Its fields, history, parameters and their ranges are those of the compiled registry, `torch_mpm.ops.LAWS`. The
    history is in state.extra, where a `Step` stores it; absent history counts as zero.
    """

    name: str
    elastic_name: ClassVar[str | None] = None
    """For a plastic law without second derivatives of its energy: name of the law of μ and λ with this energy."""
    scene_defaults: ClassVar[dict[str, float]] = {}
    """Density [kg/m³] and other defaults in scene files."""

    def __init_subclass__(cls) -> None:
        if "name" in vars(cls):
            cls._describe(cls)

    def __init__(self) -> None:
        super().__init__()
        self._kept_parameters, self._kept_scalars = DeviceConstantCache(), DeviceConstantCache()
        self._kept_tables = DeviceConstantCache()
        self._functions = False

    def __setattr__(self, name: str, value: Any) -> None:
        """A value that replaces a parameter is checked and stored as those of the constructor. Values of tensors on
        other devices than the CPU are not checked, since that would wait for the device."""
        stores = [self.__dict__.get(part, {}) for part in ("_parameters", "_buffers", "_modules")]
        places = [part for part in (vars(self), *stores) if name in part]
        range_ = self._range(name) if places else None
        if range_ is None:
            super().__setattr__(name, value)
            return
        if not isinstance(value, Tensor) or (value.device.type == "cpu" and not is_traced(value)):
            check_value(*(ARGUMENTS.get(name, name), value, *range_))
        for part in places:
            del part[name]
        self._store(name, value)
        functions = [name for name, v in self._stored().items() if callable(v) and not isinstance(v, Tensor)]
        self._functions = any([self._range(name) is not None for name in functions])

    @staticmethod
    def _describe(target: Any) -> None:
        """Set the attributes that a step reads from the registry, on a class or on one instance."""
        info = LAWS[target.name]
        target.state_fields = (info.field,)
        target.extra_fields = tuple(q.name for q in info.history)
        target.viscous, target.rate_dependent = info.viscous, info.rate_dependent

    def values(self) -> Sequence[Value]:
        """The parameters of the compiled law, in its order; without the time step."""
        return [getattr(self, p.name) for p in LAWS[self.name].parameters if p.name != "dt"]

    def return_map(self, state: State, details: bool | int = False) -> LawUpdate:
        """Complete result of the law: with details also dissipated energy, multiplier, branches and convergence."""
        deformation, parameters = self._arguments(state)
        C = state.C if self.viscous else None
        return law_update(
            self._name(state),
            deformation,
            parameters,
            self._history(state),
            C,
            state.scene,
            state.x.shape[1],
            self._options(),
            details,
            self._scenes(state, parameters),
        )

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        info = LAWS[self.name]
        flows = info.plastic or bool(info.history)
        result = self.return_map(state, DISSIPATED if self.dissipation and flows else False)
        fields = dict(zip(self.history_names(), result.history, strict=True))
        if info.plastic:
            fields[info.field] = result.state
        if result.dissipated is not None:
            fields["dissipated"] = result.dissipated
        return fields, result.stress

    def out_of_plane_stress(self, state: State) -> Tensor:
        """τ_zz [P] [Pa] of plane strain: ∂ψ/∂ln F_zz at F_zz = 1, since plastic flow in 2-D stays in the plane."""
        if self.state_fields == ("J",):  # Beside the pressure a fluid has a deviator in the plane only.
            return self.stress(state).diagonal(dim1=1, dim2=2).mean(1)
        mapped = self.return_map(state)
        law, moduli, options = self._elastic_law(state, mapped.history)
        F = torch.nn.functional.pad(mapped.state, (0, 1, 0, 1))
        F[:, 2, 2] = 1
        scenes = self._scenes(state, moduli)
        return law_update(law, F, moduli, scene=state.scene, options=options, scenes=scenes).stress[:, 2, 2]

    def _elastic_law(self, state: State, history: Sequence[Tensor]) -> tuple[str, list[Tensor], Sequence[str]]:
        """Compiled law with the elastic energy of this one in 2-D and 3-D: its name, parameters and options."""
        _, parameters = self._arguments(state)
        if self.elastic_name is None:
            return self.name, parameters, ()
        return self.elastic_name, self._elastic_moduli(state, parameters, history), ()

    def volume_ratio(self, state: State) -> Tensor:
        """J or det F [P], times the plastic volume ratio where the law stores one."""
        elastic = super().volume_ratio(state)
        if PLASTIC_VOLUME not in self.extra_fields:
            return elastic
        return elastic * self._history(state)[self.history_names().index(PLASTIC_VOLUME)].exp()

    def energy_density(self, state: State) -> Tensor:
        """Elastic energy per rest volume [P] [J/m³] after the return map."""
        name, deformation, parameters, history, scene, dim, scenes = self._of_the_ops(state)
        if LAWS[self.name].plastic or history:
            moved = self.return_map(state)
            deformation, history = moved.state, moved.history
        return law_energy(name, deformation, parameters, history, scene, dim, scenes)

    def trial_energy(self, state: Any, before: Any) -> Tensor:
        energy = law_energy(*self._of_the_ops(state))
        if not self.viscous or state.C is None:
            return energy
        return energy + 0.5 * state.step * (self._viscous_stress(state, before) * state.C).sum((1, 2))

    def trial_stress(self, state: Any, before: Any, flows: bool = False) -> Tensor:
        if flows and LAWS[self.name].plastic:
            return flowing_stress(self, state, before)
        gradient = self._energy_gradient(state)
        if self.state_fields != ("J",):
            return product(gradient, before.F.mT)
        eye = torch.eye(state.x.shape[1], dtype=gradient.dtype, device=gradient.device)
        stress = (gradient * before.J)[:, None, None] * eye
        return stress + self._viscous_stress(state, before) if self.viscous else stress

    def trial_tangent(self, state: Any, before: Any, weight: Tensor, projected: bool, flows: bool = False) -> Tensor:
        if flows and LAWS[self.name].plastic:
            return flowing_tangent(self, state, before, weight, projected)
        name, deformation, parameters, history, scene, dim, scenes = self._of_the_ops(state)
        before_field = getattr(before, self.state_fields[0])
        tangent = law_tangent(
            *(name, deformation, before_field, weight, parameters, history, scene, dim, projected, scenes)
        )
        viscosity = self.viscosity(before)
        if viscosity is not None:  # For a fluid, whose frames are the identity: 2 η dev sym L.
            add_deviator(tangent, dim, 2 * viscosity * torch.where(weight > 0, weight / state.step, 0))
        return tangent

    def trial_skew(self, state: Any, weight: Tensor) -> Tensor:
        return flowing_skew(self, state, weight) if LAWS[self.name].plastic else super().trial_skew(state, weight)

    def _energy_gradient(self, state: Any) -> Tensor:
        """∂ψ/∂F or ∂ψ/∂J of the state itself, differentiable once more."""
        name, deformation, parameters, history, scene, dim, scenes = self._of_the_ops(state)
        if self.elastic_name is None:
            return law_energy_gradient(name, deformation, parameters, history, scene, dim, scenes)
        moduli = self._elastic_moduli(state, parameters, history)
        return law_energy_gradient(self.elastic_name, deformation, moduli, (), scene, dim, scenes)

    def _elastic_moduli(self, state: Any, parameters: list[Tensor], history: Sequence[Tensor]) -> list[Tensor]:
        """μ and λ with which the law `elastic_name` has the energy of this one."""
        return parameters[:2]

    def _viscous_stress(self, state: Any, before: Any) -> Tensor:
        """Contribution of the velocity gradient of a step to the stress, at the volume before it [P, D, D] [Pa]."""
        name, J, parameters, history, scene, dim, scenes = self._of_the_ops(before)
        moving, still = (
            law_update(name, J, parameters, history, C, scene, dim, scenes=scenes).stress for C in (state.C, None)
        )
        return moving - still

    def _of_the_ops(
        self, state: Any
    ) -> tuple[str, Tensor, list[Tensor], Sequence[Tensor], Tensor | None, int, int | None]:
        """Arguments of the ops of energy and moduli: law, state, parameters, history, scene, dimension and scenes."""
        deformation, parameters = self._arguments(state)
        batch = state.scene, state.x.shape[1], self._scenes(state, parameters)
        return self._name(state), deformation, parameters, self._history(state), *batch

    def _scenes(self, state: State, parameters: Sequence[Tensor]) -> int | None:
        """Number of scenes, where a parameter is given per scene."""
        P = state.x.shape[0]
        return None if all([needs_no_scenes(p, P) for p in parameters]) else state.scenes

    def wave_modulus(self, state: State) -> Tensor:
        """Upper bound of rest density times squared wave speed after the return map [P] [Pa]; exact at rest."""
        return self._modulus(law_wave_modulus, state)

    def stiffness(self, state: State) -> Tensor:
        """Upper bound of the elastic tangent modulus after the return map [P] [Pa]."""
        return self._modulus(law_stiffness, state)

    def _modulus(self, op: Callable[..., Tensor], state: State) -> Tensor:
        return op(*self._of_the_ops(state))

    def _name(self, state: State) -> str:
        """Name of the compiled law, which may depend on the dimension."""
        return self.name

    def _options(self) -> Sequence[str]:
        return ()

    def history_names(self) -> list[str]:
        """History of the compiled law, in its order."""
        return [q.name for q in LAWS[self.name].history if q.name in self.extra_fields] if self.extra_fields else []

    def _history(self, state: State) -> list[Tensor]:
        return [state.extra[n] if n in state.extra else self.initial(n, state) for n in self.history_names()]

    def is_all_of_its_update(self) -> bool:
        """Whether `update` equals the compiled law, so that a kernel may replace it."""
        return type(self).update is CompiledLaw.update

    def figures_are_compiled(self) -> bool:
        """Whether stress, stiffness and energy are those of the compiled law alone, which one op computes together."""
        own = (getattr(type(self), name) is getattr(CompiledLaw, name) for name in FIGURES)
        return self.is_all_of_its_update() and all(own)

    @property
    def has_functions(self) -> bool:
        """Whether a parameter is a function of temperature."""
        return self._functions

    def option_bits(self) -> int:
        """Options of the compiled law as arguments of its op."""
        return option_bits(self.name, self._options())

    def initial(self, name: str, state: State) -> Tensor:
        P, D = state.x.shape
        if any(q.name == name and q.matrix for q in LAWS[self.name].history):
            return soa_empty(state.x, (P, D, D)).zero_()
        return torch.zeros_like(state.mass)

    def _range(self, name: str) -> Range | None:
        """Range of the parameter that is stored under a name; None for other attributes."""
        info = LAWS.get(getattr(self, "name", ""))
        found = [] if info is None else [p for p in info.parameters if p.name == name and name != "dt"]
        return (found[0].expected, found[0].holds) if found else None

    def _add(self, name: str, value: Value) -> None:
        """Check a parameter of the law against its range and store it."""
        range_ = self._range(name)
        assert range_ is not None
        self._store(name, check_value(ARGUMENTS.get(name, name), value, *range_))

    def _store(self, name: str, value: Value) -> None:
        """Store a parameter as number, buffer, nn.Parameter or function, so that `.to` and optimizers find it."""
        if not isinstance(value, Tensor):
            setattr(self, name, value if callable(value) else float(value))
            self._functions = self._functions or callable(value)
        elif isinstance(value, nn.Parameter):
            self.register_parameter(name, value)
        else:
            self.register_buffer(name, value)

    def _arguments(self, state: State) -> tuple[Tensor, list[Tensor]]:
        field = self.state_fields[0]
        deformation = getattr(state, field)
        if deformation is None:
            raise ValueError(f"{type(self).__name__} needs state.{field}, which is None")
        parameters = self._parameters_of(state)
        if self.rate_dependent:
            dt, like = getattr(state, "dt", 0.0), {"dtype": deformation.dtype, "device": deformation.device}
            parameters = [*parameters, dt.to(**like) if isinstance(dt, Tensor) else torch.full((), dt, **like)]
        return deformation, parameters

    def check_parameters(self, particles: int, scenes: int | None) -> None:
        for values in (self._parameters, self._buffers, self._modules):
            for name, value in values.items():
                if isinstance(value, (Tensor, PerMaterial)):
                    check_length(ARGUMENTS.get(name, name), value, particles, scenes)

    def _stored(self) -> dict[str, Any]:
        """Attributes that may be parameters, by the names under which they are stored; in compiled code only registered
        ones, since compilers of torch 2.11 do not support the others.
        """
        registered = {**self._parameters, **self._buffers, **self._modules}
        if torch.compiler.is_compiling():
            return registered
        return registered | {name: v for name, v in vars(self).items() if type(v) not in _NO_VALUES}

    def _parameters_of(self, state: State) -> list[Tensor]:
        """Parameters in the dtype, on the device and in the particle order of the state.

        Cached while nothing has changed and none requires grad.
        """
        if self._functions:
            in_order: Any = Overlay(state, ids=None)  # Evaluated parameters have this form already.
            return self._at_temperature(state)._convert(in_order)
        stored = self._stored().values()
        tensors = [value for value in stored if isinstance(value, Tensor)]
        x, order = state.x, None
        particles = getattr(state, "particles", x.shape[0])
        if not all([needs_no_scenes(t, particles) for t in tensors]):
            self.check_parameters(particles, state.scenes)
        if torch.compiler.is_compiling() or any([t.requires_grad for t in tensors]):
            return self._convert(state)
        if any([t.numel() == particles for t in tensors]):
            order = state.ids  # Only parameters that differ by particle.
        numbers = [value for value in stored if isinstance(value, (float, int, Real))]
        key = (x.dtype, x.device, order, *numbers, *tensors)
        return self._kept_parameters.get(key, lambda: self._convert(state), x)

    def _at_temperature(self, state: State) -> CompiledLaw:
        """The law with its parameters at the temperature of each particle, in the order of the state."""
        law: CompiledLaw = object.__new__(type(self))
        law.__dict__ = {**self.__dict__, "_parameters": {}, "_buffers": {}, "_modules": {}}
        for name, value in self._stored().items():
            if isinstance(value, Tensor) or (callable(value) and not name.startswith("_")):
                law.__dict__[name] = evaluate(ARGUMENTS.get(name, name), value, state)
        return law

    def _convert(self, state: State) -> list[Tensor]:
        x, particles, values = state.x, getattr(state, "particles", state.x.shape[0]), self.values()
        numbers = iter(self._scalars([float(v) for v in values if not isinstance(v, Tensor)], x))  # type: ignore[arg-type]
        result = []
        for value in values:
            tensor = value.to(x.device, x.dtype) if isinstance(value, Tensor) else next(numbers)
            if state.ids is not None and particles > 1 and tensor.shape == (particles,):
                tensor = tensor.index_select(0, state.ids)
            result.append(tensor)
        return result

    def _scalars(self, numbers: list[float], x: Tensor) -> list[Tensor]:
        """Numbers as tensors [] in the dtype and on the device of x, cached between calls."""

        def make() -> list[Tensor]:  # No copies from the host, which graphs refuse.
            return [torch.full((), number, dtype=x.dtype, device=x.device) for number in numbers]

        if is_traced(x):
            return make()
        return self._kept_scalars.get((*numbers, x.dtype, x.device), make, x)


MODULI: dict[str, Range] = {
    "E": ("finite and not negative", lambda v: v >= 0),
    "nu": ("between -1 and 0.5", lambda v: (v > -1) & (v < 0.5)),
    "mu": ("finite and not negative", lambda v: v >= 0),
    "lam": ("finite", lambda v: v == v),
}
"""Ranges of elastic moduli."""


class SolidLaw(CompiledLaw):
    """A compiled law with two elastic moduli, given as Young's modulus and Poisson's ratio or as Lamé parameters.

    Attributes:
        engineering: whether they are Young's modulus and Poisson's ratio.
    """

    E: Any  # Numbers, buffers or nn.Parameters.
    nu: Any
    mu: Any
    lam: Any

    def __init__(
        self, E: Value | None = None, nu: Value | None = None, mu: Value | None = None, lam: Value | None = None
    ) -> None:
        super().__init__()
        given = {k: v for k, v in (("E", E), ("nu", nu), ("mu", mu), ("lam", lam)) if v is not None}
        if set(given) not in ({"E", "nu"}, {"mu", "lam"}):
            found = ", ".join(given) or "nothing"
            raise ValueError(f"{type(self).__name__} needs E and nu, or mu and lam, got {found}")
        if E is not None and nu is not None:
            self._add("E", E)
            self._add("nu", nu)
            if len({v.numel() for v in (E, nu) if isinstance(v, Tensor) and v.numel() > 1}) > 1:
                raise ValueError(f"E and nu must have one shape where both vary, got {shape_of(E)} and {shape_of(nu)}")
        elif mu is not None and lam is not None:
            self._add("mu", mu)
            self._add("lam", lam)
        self.engineering = E is not None

    def _range(self, name: str) -> Range | None:
        return MODULI.get(name) or super()._range(name)

    def values(self) -> Sequence[Value]:
        """μ and λ [Pa], then the other parameters of the law in its order, without the time step."""
        others = [getattr(self, p.name) for p in LAWS[self.name].parameters[2:] if p.name != "dt"]
        return *self._lame(), *others

    def _lame(self) -> tuple[Any, Any]:
        if not self.engineering:
            return self.mu, self.lam
        E, nu = self.E, self.nu
        factors = 0.5 / (1 + nu), nu / ((1 + nu) * (1 - 2 * nu))
        if isinstance(E, Tensor) and not isinstance(nu, Tensor):  # For E as a function of temperature: in one kernel.
            mu, lam = torch._foreach_mul([E, E], factors)
            return mu, lam
        return E * factors[0], E * factors[1]


def check_value(name: str, value: Value, expected: str, holds: Callable[[Any], Any], infinite: bool = False) -> Value:
    """A value whose numbers satisfy the condition, and are finite unless infinity is allowed; a function is not
    evaluated.
    """
    if isinstance(value, PerMaterial):
        for k, one in enumerate(value.values()):
            check_value(f"{name} of material {k}", one, expected, holds, infinite)
    kinds = "a number, a tensor or a function of temperature"
    if isinstance(value, Material):
        raise TypeError(f"{name} must be {kinds}, got {shape_of(value)}")
    if callable(value) and not isinstance(value, Tensor):
        return value
    if isinstance(value, Tensor):
        refuse_batched(name, value)
        if value.dim() > 1 or value.numel() == 0 or not value.is_floating_point():
            raise ValueError(
                f"{name} must be a number or a floating tensor of shape [], [1], [B] or [P], got {shape_of(value)}"
            )
        if value.is_meta:
            raise ValueError(f"{name} must have values, got a tensor on the device meta")
        if not bool((holds(value.detach()) & (value.detach().isfinite() | infinite)).all()):
            raise ValueError(f"{name} must be {expected}, got {value}")
        return value
    return float(
        check_number(name, value, expected, lambda v: (math.isfinite(v) or infinite) and bool(holds(v)), kinds)
    )
