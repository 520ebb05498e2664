"""Constitutive laws: modules from the deformation of a state to its Kirchhoff stress.

A law is a `Material`. Those compiled in csrc/laws take parameters that are numbers or tensors of shape [], [1],
[B] (per scene) or [P] (per particle, in the order of `state.ids` where particles were reordered; also where P = B), and
pass gradients to them. A parameter may also be a function of temperature, [P] -> [P] (`Table`, an `nn.Module`, any
torch code), evaluated at state.temperature. `CustomLaw` makes a law of any module, `Mixture` combines several in one
state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor, nn

from ..capture import Kept, without_transforms
from ..errors import check_number, shape_of
from ..ops.arguments import per_parameter, soa_empty
from ..ops.law import DISSIPATED, LawUpdate, law_energy, law_stiffness, law_update, law_wave_modulus
from ..ops.registry import LAWS, Quantity
from ..parameters import PerMaterial, Value, With, evaluate
from ..state import _take
from .tangent import differentiated_stiffness

if TYPE_CHECKING:
    from ..state import State


class Material(nn.Module):
    """A constitutive law. A subclass sets `state_fields` and defines `update`; the other methods where it can.

    Attributes:
        state_fields: fields of the state that a step moves for the law: "F" or "J".
        extra_fields: tensors [P] of state.extra that the law keeps from step to step, zero at first: its history.
        viscous: whether the stress reads state.C, so that a step has to keep it.
        rate_dependent: whether `update` reads state.dt, the time step [s], which a step then adds to the state.
        dissipation: whether somebody wants "dissipated" from `update`, which costs something. A step with plastic
            heating sets it on its law and on those inside.
    """

    state_fields: tuple[str, ...] = ("F",)
    extra_fields: tuple[str, ...] = ()
    viscous: bool = False
    rate_dependent: bool = False
    dissipation: bool = False

    def forward(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        """`update`, as a step calls it, with the hooks of the module."""
        return self.update(state)

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        """Fields that the law changes (plastic laws: F at the yield surface), and Kirchhoff stress [P, D, D] [Pa].

        `extra_fields` are among the fields, under their own names.
        A law that dissipates adds "dissipated" to the fields where `dissipation` is set: the energy that this step's
        plastic flow turned into heat, per rest volume [P] [J/m³].
        """
        raise NotImplementedError

    def stress(self, state: State) -> Tensor:
        """Kirchhoff stress τ [P, D, D] [Pa]."""
        return self.update(state)[1]

    def energy_density(self, state: State) -> Tensor:
        """Elastic energy per rest volume [P] [J/m³]; infinite where the law has no meaning."""
        raise NotImplementedError(f"{type(self).__name__} has no energy")

    def energy(self, state: State) -> Tensor:
        """Elastic energy of each particle [P] [J]."""
        return self.energy_density(state) * state.volume

    def stiffness(self, state: State) -> Tensor:
        """Upper bound of the tangent modulus over all velocity gradients of unit norm [P] [Pa]; limits the step.

        By automatic differentiation of `update` here: D² backward passes, for laws in which each particle's stress
        follows from its own state. Zero where it is not finite.
        """
        return differentiated_stiffness(self, state)

    def wave_modulus(self, state: State) -> Tensor:
        """Rest density times the square of the largest wave speed [P] [Pa]."""
        return self.stiffness(state)

    def wave_speed(self, state: State) -> Tensor:
        """Speed of the fastest elastic wave in the deformed material [P] [m/s]: an upper bound, at most 16% above."""
        return (self.wave_modulus(state) * state.volume / state.mass).sqrt()

    def viscosity(self, state: State) -> Tensor | None:
        """Viscosity in terms of Kirchhoff stress [P] [Pa s], or None."""
        return None

    def invalid(self, state: State) -> Tensor:
        """Particles where the law has no meaning, bool [P]: not finite, overflowed, or turned inside out (J ≤ 0)."""
        return ~self.energy_density(state).isfinite()


class CompiledLaw(Material):
    """A law of csrc/laws; subclasses say which, and convert their arguments to its parameters.

    Its fields, history, parameters and their ranges are those of the compiled registry, `torch_mpm.ops.LAWS`. The
    history is in state.extra, where a `Step` keeps it; what is absent counts as zero.
    """

    name: str
    scene_defaults: ClassVar[dict[str, float]] = {}
    """Density [kg/m³] and other values that a scene file takes for what it does not say."""

    def __init_subclass__(cls) -> None:
        if "name" in vars(cls):
            cls._describe(cls)

    def __init__(self) -> None:
        super().__init__()
        self._kept_parameters = Kept()
        self._functions = False

    @staticmethod
    def _describe(target: Any) -> None:
        """Set what a step asks a law from the registry, on a class or on one instance."""
        info = LAWS[target.name]
        target.state_fields = (info.field,)
        target.extra_fields = tuple(q.name for q in info.history)
        target.viscous, target.rate_dependent = info.viscous, info.rate_dependent

    def values(self) -> Sequence[Value]:
        """The parameters of the compiled law, in its order; without the time step."""
        return [getattr(self, p.name) for p in LAWS[self.name].parameters if p.name != "dt"]

    def return_map(self, state: State, details: bool | int = False) -> LawUpdate:
        """The whole result of the law: with details also dissipated energy, multiplier, branches and convergence."""
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
        )

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        result = self.return_map(state, DISSIPATED if self.dissipation else False)
        if not LAWS[self.name].plastic:
            return {}, result.stress
        fields = {self.state_fields[0]: result.state, **dict(zip(self.extra_fields, result.history, strict=True))}
        if result.dissipated is not None:
            fields["dissipated"] = result.dissipated
        return fields, result.stress

    def energy_density(self, state: State) -> Tensor:
        """Elastic energy per rest volume [P] [J/m³] after the return map."""
        deformation, parameters = self._arguments(state)
        history: Sequence[Tensor] = self._history(state)
        if LAWS[self.name].plastic:
            moved = self.return_map(state)
            deformation, history = moved.state, moved.history
        return law_energy(self._name(state), deformation, parameters, history, state.scene, state.x.shape[1])

    def wave_modulus(self, state: State) -> Tensor:
        """Upper bound of rest density times squared wave speed after the return map [P] [Pa]; exact at rest."""
        return self._modulus(law_wave_modulus, state)

    def stiffness(self, state: State) -> Tensor:
        """Upper bound of the elastic tangent modulus after the return map [P] [Pa]."""
        return self._modulus(law_stiffness, state)

    def _modulus(self, op: Callable[..., Tensor], state: State) -> Tensor:
        deformation, parameters = self._arguments(state)
        return op(self._name(state), deformation, parameters, self._history(state), state.scene, state.x.shape[1])

    def _name(self, state: State) -> str:
        """The compiled law, which may depend on the dimension."""
        return self.name

    def _options(self) -> Sequence[str]:
        return ()

    def _history(self, state: State) -> list[Tensor]:
        return [_kept(q, state) for q in LAWS[self.name].history if q.name in self.extra_fields]

    def _add(self, name: str, value: Value) -> None:
        """Check a parameter of the law against its range and keep it."""
        quantity = LAWS[self.name].parameter(name)
        self._store(name, _check_value(name, value, quantity.expected, quantity.holds))

    def _store(self, name: str, value: Value) -> None:
        """Keep a parameter as number, buffer, nn.Parameter or function, so that `.to` and optimizers find it."""
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

    def _parameters_of(self, state: State) -> list[Tensor]:
        """Parameters in the dtype, on the device and in the particle order of the state.

        Kept from call to call while nothing has changed and none requires grad.
        """
        if self._functions:
            in_order: Any = With(state, ids=None)  # which evaluated parameters already are
            return self._at_temperature(state)._convert(in_order)
        tensors = [t for t in (*self._parameters.values(), *self._buffers.values()) if t is not None]
        if torch.compiler.is_compiling() or any(t.requires_grad for t in tensors):
            return self._convert(state)
        numbers = [value for value in vars(self).values() if isinstance(value, float)]
        key = (state.x.dtype, state.x.device, state.ids, *numbers, *((t, t._version) for t in tensors))
        return self._kept_parameters.get(key, lambda: self._convert(state), state.x)

    def _at_temperature(self, state: State) -> CompiledLaw:
        """The law with its parameters at the temperature of each particle, in the order of the state."""
        law: CompiledLaw = object.__new__(type(self))
        law.__dict__ = {**self.__dict__, "_parameters": {}, "_buffers": {}, "_modules": {}}
        stored = {**vars(self), **self._parameters, **self._buffers, **self._modules}
        for name, value in stored.items():
            if isinstance(value, Tensor) or (callable(value) and not name.startswith("_")):
                law.__dict__[name] = evaluate(name, value, state)
        return law

    def _convert(self, state: State) -> list[Tensor]:
        x, particles = state.x, getattr(state, "particles", state.x.shape[0])
        result = []
        for value in self.values():
            tensor = torch.as_tensor(value, dtype=x.dtype, device=x.device)
            if state.ids is not None and particles > 1 and tensor.shape == (particles,):
                tensor = tensor.index_select(0, state.ids)
            result.append(tensor)
        return result


def _kept(quantity: Quantity, state: State) -> Tensor:
    """A history variable in `State.extra`, zero at first."""
    value = state.extra.get(quantity.name)
    if value is not None:
        return value
    P, D = state.x.shape
    return soa_empty(state.x, (P, D, D)).zero_() if quantity.matrix else torch.zeros_like(state.mass)


def _check_value(name: str, value: Value, expected: str, holds: Callable[[Any], Any], infinite: bool = False) -> Value:
    """A value whose numbers hold, and are finite unless they may be infinite; a function is not asked."""
    if isinstance(value, PerMaterial):
        for k, one in enumerate(value.values()):
            _check_value(f"{name} of material {k}", one, expected, holds, infinite)
    kinds = "a number, a tensor or a function of temperature"
    if isinstance(value, Material):
        raise TypeError(f"{name} must be {kinds}, got {shape_of(value)}")
    if callable(value) and not isinstance(value, Tensor):
        return value
    if isinstance(value, Tensor):
        if value.dim() > 1 or value.numel() == 0 or not value.is_floating_point():
            raise ValueError(
                f"{name} must be a number or a floating tensor of shape [], [1], [B] or [P], got {shape_of(value)}"
            )
        if not bool((holds(value.detach()) & (value.detach().isfinite() | infinite)).all()):
            raise ValueError(f"{name} must be {expected}, got {value}")
        return value
    return float(
        check_number(name, value, expected, lambda v: (math.isfinite(v) or infinite) and bool(holds(v)), kinds)
    )


class SolidLaw(CompiledLaw):
    """A compiled law with two elastic moduli, given as Young's modulus and Poisson's ratio or as Lamé parameters."""

    E: Any  # numbers, buffers or nn.Parameters
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
            self._store("E", _check_value("E", E, "finite and not negative", lambda v: v >= 0))
            self._store("nu", _check_value("nu", nu, "between -1 and 0.5", lambda v: (v > -1) & (v < 0.5)))
            if len({v.numel() for v in (E, nu) if isinstance(v, Tensor) and v.numel() > 1}) > 1:
                raise ValueError(f"E and nu must have one shape where both vary, got {shape_of(E)} and {shape_of(nu)}")
        elif mu is not None and lam is not None:
            self._store("mu", _check_value("mu", mu, "finite and not negative", lambda v: v >= 0))
            self._store("lam", _check_value("lam", lam, "finite", lambda v: v == v))
        self._engineering = E is not None

    def values(self) -> Sequence[Value]:
        """μ and λ [Pa], then the other parameters of the law in its order, without the time step."""
        others = [getattr(self, p.name) for p in LAWS[self.name].parameters[2:] if p.name != "dt"]
        return *self._lame(), *others

    def _lame(self) -> tuple[Any, Any]:
        if not self._engineering:
            return self.mu, self.lam
        E, nu = self.E, self.nu
        return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))


class NeoHookean(SolidLaw):
    """Compressible neo-Hookean solid: τ = μ (F Fᵀ − I) + λ ln J I (Bonet and Wood 2008, section 6.4.3).

    Args:
        E: Young's modulus [Pa], not negative, with nu; or
        nu: Poisson's ratio in (−1, 0.5).
        mu: shear modulus [Pa], not negative (0 is a fluid), with lam; or
        lam: first Lamé parameter [Pa].

    Raises:
        ValueError: for a value outside its range, or another combination of arguments. Values are checked here, and not
            again when a tensor is changed or trained.
    """

    name = "neo_hookean"


class WeaklyCompressible(CompiledLaw):
    """Fluid with Tait-Murnaghan pressure (Monaghan 1994): p = K/γ (J^−γ − 1), τ = −J p I + 2 J η dev(sym C).

    It stores J and no F. γ = 1 is the linear law τ = K (J − 1) I. At rest the speed of sound is √(K/ρ).

    Args:
        bulk_modulus: K [Pa], not negative.
        gamma: γ, positive; 7 for water.
        viscosity: η [Pa s], not negative. 0 (the number) costs nothing.

    Raises:
        ValueError: for a value outside its range.
    """

    name = "weakly_compressible"
    bulk_modulus: Any
    gamma: Any
    eta: Any

    def __init__(self, bulk_modulus: Value, gamma: Value = 7.0, viscosity: Value = 0.0) -> None:
        super().__init__()
        self._add("bulk_modulus", bulk_modulus)
        self._add("gamma", gamma)
        quantity = LAWS["viscous_fluid"].parameter("viscosity")
        self._store("eta", _check_value("viscosity", viscosity, quantity.expected, quantity.holds))
        if isinstance(viscosity, Tensor) or callable(viscosity) or viscosity > 0:
            self.name = "viscous_fluid"
            self._describe(self)

    def values(self) -> Sequence[Value]:
        """K [Pa], γ and, of a viscous fluid, η [Pa s]."""
        elastic = (self.bulk_modulus, self.gamma)
        return (*elastic, self.eta) if self.viscous else elastic

    def viscosity(self, state: State) -> Tensor | None:
        if not self.viscous:
            return None
        J, (_, _, eta) = self._arguments(state)
        return J * per_parameter(eta, state.scene, J.shape[0])


class CustomLaw(Material):
    """A law from any module or function: F [P, D, D] -> Kirchhoff stress [P, D, D] [Pa], in ordinary torch code.

    Args:
        function: called with the state field. It may return a pair (F, stress) instead, with F what a plastic law makes
            of its argument.
        state_field: "F", or "J" [P] for a law of the volume ratio alone.
        stiffness: see `Material.stiffness`; a number, a tensor [P] or a function of the state. None takes it from the
            function by automatic differentiation, each time that `stable_dt` asks.

    A law that needs more than this (other fields, history) is a subclass of `Material`.

    Raises:
        TypeError: for what is no function.
        ValueError: for an unknown field, a number as stiffness that is negative or not finite, or in use for a result
            of another shape.
    """

    def __init__(
        self,
        function: Callable[[Tensor], Any],
        state_field: str = "F",
        stiffness: float | Tensor | Callable[[State], Tensor] | None = None,
    ) -> None:
        super().__init__()
        if state_field not in ("F", "J"):
            raise ValueError(f"state_field must be 'F' or 'J', got {state_field!r}")
        self.function = check_function(function)
        self.state_fields = (state_field,)
        self._stiffness = check_stiffness(stiffness)

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        (field,) = self.state_fields
        deformation = getattr(state, field)
        result = self.function(deformation)
        new, stress = result if isinstance(result, tuple) else (deformation, result)
        P, D = state.x.shape
        for name, value, shape in ((field, new, tuple(deformation.shape)), ("stress", stress, (P, D, D))):
            if not isinstance(value, Tensor) or tuple(value.shape) != shape:
                raise ValueError(f"the law must return {name} of shape {list(shape)}, got {shape_of(value)}")
        return {} if new is deformation else {field: new}, stress

    def stiffness(self, state: State) -> Tensor:
        return given_stiffness(self._stiffness, state) if self._stiffness is not None else super().stiffness(state)

    def invalid(self, state: State) -> Tensor:
        (field,) = self.state_fields
        deformation: Tensor = getattr(state, field)
        J = deformation if field == "J" else torch.linalg.det(deformation.where(deformation.isfinite(), torch.nan))
        return ~((J > 0) & J.isfinite())


def check_function(function: Any) -> Any:
    """The function of a custom law."""
    if not callable(function):
        raise TypeError(f"function must be a function or module, got {shape_of(function)}")
    return function


def check_stiffness(value: Any) -> Any:
    """A stiffness that is given to a custom law."""
    if value is not None and not isinstance(value, Tensor) and not callable(value):
        return float(check_number("stiffness", value, "finite and not negative", lambda v: 0 <= v < math.inf))
    return value


def given_stiffness(value: Any, state: State) -> Tensor:
    """[P]"""
    value = value(state) if callable(value) else value
    return torch.as_tensor(value, dtype=state.x.dtype, device=state.x.device).expand(state.x.shape[0])


def as_law(name: str, law: Any) -> Material:
    """A material as it is; a function or module F [P, D, D] -> Kirchhoff stress as a `CustomLaw`.

    Raises:
        TypeError: for anything else.
    """
    if isinstance(law, Material):
        return law
    if isinstance(law, type) or hasattr(law, "update") or not callable(law):
        found = f"the class {law.__name__}" if isinstance(law, type) else shape_of(law)
        raise TypeError(
            f"{name} must be a material (an instance of torch_mpm.Material), or a function or module from the "
            f"deformation gradient [P, D, D] to the Kirchhoff stress, got {found}"
        )
    return CustomLaw(law)


class Mixture(Material):
    """Several laws in one state: law k for the particles with state.material = k.

    The particles of each law are found once per `state.material` tensor, which synchronises with the device; replace
    the tensor rather than write into it. Per-particle parameters of the laws have shape [P] for the whole state.

    Args:
        laws: at least one; functions and modules F -> τ as by `CustomLaw`.

    Raises:
        TypeError: for what is no law.
        ValueError: without laws, or in use without state.material or with an id outside 0 .. len(laws) − 1.
    """

    def __init__(self, laws: Sequence[Material | Callable[[Tensor], Any]]) -> None:
        super().__init__()
        if not isinstance(laws, (list, tuple, nn.ModuleList)):
            raise TypeError(f"laws must be a list of materials, got {shape_of(laws)}")
        if len(laws) == 0:
            raise ValueError("Mixture needs at least one law")
        parts = [as_law(f"laws[{k}]", law) for k, law in enumerate(laws)]
        self.laws = nn.ModuleList(parts)
        self.state_fields = tuple(sorted({field for law in parts for field in law.state_fields}))
        self.extra_fields = tuple(sorted({field for law in parts for field in law.extra_fields}))
        self.viscous = any(law.viscous for law in parts)
        self._material: Tensor | None = None
        self._indices: list[Tensor] = []

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        changes: dict[str, Tensor] = {}
        P, D = state.x.shape
        stress = soa_empty(state.x, (P, D, D))
        for part, law in self._parts(state):
            fields, part_stress = law(part)
            stress = stress.index_copy(0, part.index, part_stress)
            for name, value in fields.items():
                if name not in changes:
                    new = name == "dissipated" or name in self.extra_fields
                    zero = value.new_zeros(P, *value.shape[1:])
                    changes[name] = state.extra.get(name, zero) if new else getattr(state, name)
                changes[name] = changes[name].index_copy(0, part.index, value)
        return changes, stress

    def energy_density(self, state: State) -> Tensor:
        return self._collect(state, lambda law, part: law.energy_density(part))

    def stiffness(self, state: State) -> Tensor:
        return self._collect(state, lambda law, part: law.stiffness(part))

    def wave_modulus(self, state: State) -> Tensor:
        return self._collect(state, lambda law, part: law.wave_modulus(part))

    def invalid(self, state: State) -> Tensor:
        return self._collect(state, lambda law, part: law.invalid(part).to(state.x.dtype)) > 0

    def viscosity(self, state: State) -> Tensor | None:
        if not self.viscous:
            return None

        def viscosity(law: Material, part: Any) -> Tensor:
            value = law.viscosity(part)
            return torch.zeros_like(part.mass) if value is None else value

        return self._collect(state, viscosity)

    def _collect(self, state: State, function: Callable[[Any, Any], Tensor]) -> Tensor:
        result = torch.zeros_like(state.mass)
        for part, law in self._parts(state):
            result = result.index_copy(0, part.index, function(law, part))
        return result

    def _parts(self, state: State) -> list[tuple[Any, Any]]:
        material = state.material
        if material is None:
            raise ValueError("a Mixture needs state.material, int32 [P]")
        if material is not self._material:
            if material.numel() and not bool(((material >= 0) & (material < len(self.laws))).all()):
                raise ValueError(
                    f"state.material must be in 0 .. {len(self.laws) - 1}, got {material.unique().tolist()}"
                )
            indices = ((material == k).nonzero().squeeze(1) for k in range(len(self.laws)))
            self._indices = [without_transforms(index) for index in indices]
            self._material = material
        return [(_Part(state, index), law) for index, law in zip(self._indices, self.laws, strict=True) if len(index)]


class _Part:
    """Some particles of a state: its fields, gathered when they are asked for."""

    def __init__(self, state: State, index: Tensor) -> None:
        self.index = index
        self.particles = state.x.shape[0]
        self.ids = index if state.ids is None else state.ids.index_select(0, index)
        self._state = state

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._state, name)
        if isinstance(value, Tensor) and name != "dt":  # which is that of the scenes
            value = _take(value, self.index)
            setattr(self, name, value)
        elif name == "extra":
            value = {key: _take(t, self.index) for key, t in value.items()}
            setattr(self, name, value)
        return value
