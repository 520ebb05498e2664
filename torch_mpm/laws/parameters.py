"""Parameters of materials: numbers, tensors per scene or particle, and functions of temperature."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from ..cuda_graphs.capture import DeviceConstantCache, is_traced
from ..errors import check_numbers, check_real, shape_of
from ..ops.arguments import per_parameter

if TYPE_CHECKING:
    from ..state.state import State

Value = float | Tensor | Callable[[Tensor], Tensor]
"""Parameter: a number; a tensor [], [1], [B] or [P]; a function of the temperature [P] [K] that returns [P], or a
`PerMaterial` of these.
"""


def _knots(name: str, given: Sequence[float] | Tensor) -> Tensor:
    """Numbers as a tensor on the default device, as modules store their tensors."""
    if isinstance(given, Tensor):
        return given
    return torch.tensor(check_numbers(f"{name} of a table", given), dtype=torch.float64)


def check_knots(name: str, knots: Tensor, of_values: str, values: Tensor) -> None:
    """Check that knots [K] increase and values at them are finite.

    Raises:
        ValueError: otherwise.
    """
    if not bool((knots.diff() > 0).all() and knots.isfinite().all()):
        raise ValueError(f"{name} must increase, got {knots.tolist()}")
    if not bool(values.detach().isfinite().all()):
        raise ValueError(f"{of_values} must be finite, got {values.tolist()}")


class Table(nn.Module):
    """Piecewise linear function of temperature, constant beyond its ends; differentiable by temperature and values.

    Its temperatures are on the device of its values. Lists follow a tensor, so that steps need no copies from the host.

    Args:
        temperature: at least two increasing numbers [K], relative to the reference of the simulation.
        value: as many numbers, or a tensor [K] that may require grad.

    Raises:
        ValueError: for temperatures that do not increase, numbers that are not finite, or different lengths.
    """

    temperature: Tensor
    value: Tensor

    def __init__(self, temperature: Sequence[float] | Tensor, value: Sequence[float] | Tensor) -> None:
        super().__init__()
        knots = _knots("temperature", temperature)
        if knots.requires_grad:
            raise ValueError("temperature of a table must not require grad: only its values are differentiable")
        knots = knots.double()
        values = _knots("value", value)
        if knots.dim() != 1 or len(knots) < 2 or values.shape != knots.shape:
            raise ValueError(
                "temperature and value of a table must be lists of one length, 2 or more, "
                f"got {shape_of(knots)} and {shape_of(values)}"
            )
        if isinstance(value, Tensor):
            knots = knots.to(values.device)
        else:
            values = values.to(knots.device)
        check_knots("temperature of a table", knots, "value of a table", values)
        self._kept = DeviceConstantCache()
        store(self, "temperature", knots)
        store(self, "value", values)

    def forward(self, temperature: Tensor) -> Tensor:
        """Values at temperatures of any shape."""
        knots, widths, values = self._like(temperature)
        left: Tensor | int = 0  # the only interval of two knots
        if len(knots) > 2:
            left = torch.bucketize(temperature.detach().contiguous(), knots[1:-1].contiguous())
        share = ((temperature - knots[left]) / widths[left]).clamp(0, 1)
        return torch.lerp(values[left], values[left + 1], share)

    def _like(self, temperature: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Knots, intervals and values in the dtype and on the device of temperatures, cached between calls."""
        own = self.temperature, self.value

        def make() -> tuple[Tensor, Tensor, Tensor]:
            knots = own[0].to(temperature)
            return knots, knots.diff(), own[1].to(temperature)

        if is_traced(temperature) or own[1].requires_grad:
            return make()
        return self._kept.get((*own, temperature.dtype, temperature.device), make, temperature)


class PerMaterial(nn.Module):
    """A `Value` for each law of a `Mixture`: value k for the particles with state.material = k.

    Args:
        values: numbers, tensors, or functions of temperature, as many as there are laws.
    """

    def __init__(self, values: Sequence[Value]) -> None:
        super().__init__()
        if not isinstance(values, (list, tuple)):
            raise TypeError(f"values must be a list of one for each material, got {shape_of(values)}")
        self.count = len(values)
        for k, value in enumerate(values):
            if not callable(value) and not isinstance(value, Tensor):
                check_real(f"values[{k}]", value, "a number, a tensor or a function of temperature")
            store(self, f"value{k}", value)

    def values(self) -> list[Value]:
        """Values, one per material."""
        return [getattr(self, f"value{k}") for k in range(self.count)]

    def of(self, name: str, state: State) -> Tensor:
        """Values [P], zero for an unknown material.

        Raises:
            ValueError: for a state without material.
        """
        if state.material is None:
            raise ValueError(f"{name} per material needs state.material, int32 [P]")
        result = torch.zeros_like(state.mass)
        for k, value in enumerate(self.values()):
            result = torch.where(state.material == k, evaluate(name, value, state), result)
        return result


def check_length(name: str, value: Any, particles: int, scenes: int | None) -> None:
    """Check the shape of a parameter of B scenes, if it is a tensor or has a shape; where B is unknown, any number of
    entries is accepted for [B].

    Raises:
        ValueError: for a shape that is not [], [1], [B] or [P].
    """
    if isinstance(value, PerMaterial):
        for k, one in enumerate(value.values()):
            check_length(f"{name} of material {k}", one, particles, scenes)
    if not isinstance(value, Tensor) or needs_no_scenes(value, particles):
        return
    if value.dim() == 1 and (value.shape[0] == scenes or (scenes is None and value.shape[0] > 0)):
        return
    batch = "" if scenes is None else f" with B = {scenes}"
    raise ValueError(f"{name} must have shape [], [1], [B] or [P] = [{particles}], got {shape_of(value)}{batch}")


def needs_no_scenes(value: Tensor, particles: int) -> bool:
    """Whether a parameter is the same for all particles, or given per particle, [P], which is also assumed where P =
    B.
    """
    return value.dim() == 0 or (value.dim() == 1 and value.shape[0] in (1, particles))


def evaluate(name: str, value: Value, state: State) -> float | Tensor:
    """A parameter as a number, a tensor of one element, or [P] in the particle order of the state.

    Raises:
        ValueError: where a tensor or the result of a function has another shape, or is on another device.
    """
    P = state.x.shape[0]
    if isinstance(value, PerMaterial):
        return value.of(name, state)
    if not isinstance(value, Tensor):
        if not callable(value):
            return value
        temperature = needed_temperature(state)
        result = value(temperature)
        if not isinstance(result, Tensor) or result.shape != temperature.shape:
            raise ValueError(
                f"{name} as a function of temperature must return shape [P] = [{P}], got {shape_of(result)}"
            )
        return result.to(state.x.dtype)
    particles = getattr(state, "particles", P)
    if not needs_no_scenes(value, particles):
        check_length(name, value, particles, state.scenes)
    value = value.to(state.x.dtype)
    if value.numel() == 1:
        return value.reshape(())
    if value.device != state.x.device:
        raise ValueError(f"{name} must be on the device of x, {state.x.device}, got {value.device}")
    if value.shape == (particles,):
        return value if state.ids is None else value.index_select(0, state.ids)
    return per_parameter(value, state.scene, P)


def needed_temperature(state: State) -> Tensor:
    """The temperature of a state [P] [K].

    Raises:
        ValueError: where the state has none.
    """
    temperature: Tensor | None = state.temperature
    if temperature is None:
        raise ValueError("state.temperature is None: set it to the temperature of each particle [P] [K]")
    return temperature


class Overlay:
    """State, or part of one, with some fields replaced."""

    def __init__(self, state: Any, **changes: Any) -> None:
        self.__dict__.update(changes)
        self._state = state

    def __getattr__(self, name: str) -> Any:
        return getattr(self._state, name)


def store(module: nn.Module, name: str, value: Any) -> None:
    """Store a parameter as number, buffer, nn.Parameter or module, so that `.to` moves it and optimizers find it."""
    if isinstance(value, nn.Parameter):
        module.register_parameter(name, value)
    elif isinstance(value, Tensor):
        module.register_buffer(name, value)
    else:
        setattr(module, name, value if callable(value) else float(value))


def has_hooks(module: nn.Module) -> bool:
    """Whether hooks run when a module is called."""
    return bool(
        module._forward_hooks or module._forward_pre_hooks or module._backward_hooks or module._backward_pre_hooks
    )


def modules_in(module: nn.Module) -> list[nn.Module]:
    """A module and those inside it, shared ones more than once: `modules` takes longer than the kernels of a small
    scene."""
    found = [module]
    for inner in module._modules.values():
        if inner is not None:
            found += modules_in(inner)
    return found


def tensors_in(module: nn.Module) -> list[Tensor]:
    """Parameters and buffers of a module and those inside it."""
    parts = modules_in(module)
    return [t for m in parts for t in (*m._parameters.values(), *m._buffers.values()) if t is not None]


class TensorModule(nn.Module):
    """Module with tensors as buffers, so that `.to` moves them and a `state_dict` contains them.

    Any attribute may be reassigned with another type: a number, a tensor, an nn.Parameter, a module. A subclass need
    not call `super().__init__`.
    """

    def __new__(cls, *arguments: Any, **named: Any) -> Any:
        module = super().__new__(cls)
        nn.Module.__init__(module)
        return module

    def __setattr__(self, name: str, value: Any) -> None:
        for stored in ("_parameters", "_buffers", "_modules"):
            self.__dict__.get(stored, {}).pop(name, None)
        if isinstance(value, Tensor) and not isinstance(value, nn.Parameter):
            self.__dict__.pop(name, None)
            self._buffers[name] = value
        else:
            super().__setattr__(name, value)
