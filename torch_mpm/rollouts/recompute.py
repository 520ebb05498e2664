"""Functions that the backward pass calls again instead of storing the inputs of their gradient.

As `torch.utils.checkpoint` without reentrance, whose first call imports compilers for seconds. Autograd stores
placeholders of the tensors of the function. The first placeholder that is read in a backward pass causes a second call
of the function, which fills all of them. So gradients of all orders pass, also to tensors that are not arguments.
"""

from __future__ import annotations

import contextlib
import threading
import uuid
import weakref
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor


def called_again(function: Callable[..., Any], *tensors: Tensor) -> Any:
    """Result of `function(*tensors)`; autograd stores the arguments only.

    The function is called again with the original random numbers, autocast and default device.

    Raises:
        RuntimeError: in the backward pass, where the second call does something else.
    """
    if not torch.is_grad_enabled():
        return function(*tensors)
    call = _Call(function, tensors)
    with torch.autograd.graph.saved_tensors_hooks(call.pack, call.unpack):
        running = _THREAD.running
        running.calls.append(call)
        try:
            return function(*tensors)
        finally:
            running.leave(call)


class _Arguments(torch.autograd.Function):
    """Node outside any graph, which stores tensors as autograd does, also inside an outer function that is called
    again.
    """

    @staticmethod
    def forward(anchor: Tensor, *tensors: Tensor) -> Tensor:
        return anchor.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[1:])

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        raise AssertionError("nothing follows from this node")

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        return torch.zeros(0, device="cpu")


class _Place:
    """Placeholder of a tensor that autograd stores, with its values by the number of the backward pass."""

    def __init__(self, t: Tensor) -> None:
        self.kind = _kind(t)
        self.values: dict[int, Tensor] = {}


class _Running:
    """Calls whose function a thread computes for the first time, the innermost last."""

    def __init__(self) -> None:
        self.calls: list[_Call] = []
        self.differentiate = False
        """Whether the functions of the latest calls computed gradients in themselves."""
        self._now = False

    def note_gradient(self) -> None:
        self._now = self.differentiate = True

    def leave(self, call: _Call) -> None:
        """End the function of the innermost call."""
        self.calls.pop()
        call.end()
        if not self.calls:
            self.differentiate, self._now = self._now, False


class _Thread(threading.local):
    def __init__(self) -> None:
        self.running = _Running()


_THREAD = _Thread()
_FILLED: dict[tuple[int, int], list[weakref.ref[_Call]]] = {}
"""Calls with filled placeholders, by the number of the backward pass and the thread."""


class _AllFound(Exception):
    """Raised when all placeholders are filled: the rest of the function need not be called."""


class _Call:
    def __init__(self, function: Callable[..., Any], tensors: Sequence[Tensor]) -> None:
        self._function = function
        self._running: _Running | None = _THREAD.running  # Until the function ends; gradients in it may use a thread.
        self._outer = self._running.calls[-1] if self._running.calls else None
        # The result, since its node releases its stored tensors when only Python holds it.
        self._arguments = _Arguments.apply(torch.empty(0, device="cpu", requires_grad=True), *tensors)
        self._place = 0 if self._outer is None else len(self._outer._places)  # After its arguments.
        self._places: list[weakref.ref[_Place]] = []
        # Tensors with their versions until the function ends, where gradients computed in it read them.
        self._held: dict[_Place, tuple[Tensor, int]] | None = {} if self._running.differentiate else None
        self._around = _surroundings({t.device for t in tensors})

    def pack(self, t: Tensor) -> _Place:
        place = _Place(t)
        self._places.append(weakref.ref(place))  # A tensor is then released with its user.
        if self._held is not None:
            self._held[place] = t.detach(), t._version
        return place

    def unpack(self, place: _Place) -> Tensor:
        backward: int = torch._C._current_graph_task_id()
        if backward == -1:  # A caller inspects a node.
            backward = uuid.uuid4().int
        if self._running is not None:
            self._running.note_gradient()
            self._held = {} if self._held is None else self._held
            held, version = self._held.get(place, (None, 0))
            if held is not None and held._version == version:
                return held
        if backward not in place.values:
            self._call_again(backward)
        return place.values.pop(backward)

    def end(self) -> None:
        """Release what gradients computed in the function have read and left."""
        self._held = self._running = None
        for reference in self._places:
            if (place := reference()) is not None:
                place.values.clear()

    def _release_read(self, backward: int) -> None:
        """Release what the backward pass has left of other calls, and of those around this one after it.

        Nodes are differentiated in the order opposite to that of their creation, so that it has passed these. What was
        filled for nodes that no gradient reaches would otherwise remain as long as the graph. Placeholders that are
        read after all are filled once more.
        """
        around, inner = dict[_Call, int](), self
        while inner._outer is not None:
            around[inner._outer], inner = inner._place, inner._outer
        for key in [key for key, calls in _FILLED.items() if all(call() is None for call in calls)]:
            _FILLED.pop(key, None)
        key = backward, threading.get_ident()
        filled = [call for reference in _FILLED.get(key, []) if (call := reference()) is not None]
        for call in filled:
            for reference in call._places[around.get(call, 0) :]:
                if (place := reference()) is not None:
                    place.values.pop(backward, None)
        _FILLED[key] = [weakref.ref(call) for call in [*(c for c in filled if c in around), self]]

    def _call_again(self, backward: int) -> None:
        self._release_read(backward)
        found = 0

        def fill(t: Tensor) -> Tensor:
            nonlocal found
            t = t.detach() if t.requires_grad else t
            if found < len(self._places):
                place = self._places[found]()
                if place is not None:
                    if place.kind != _kind(t):
                        raise RuntimeError(
                            f"{CHANGED}: {_in_words(place.kind)} the first time, then {_in_words(_kind(t))}"
                        )
                    place.values[backward] = t
                found += 1
                if found == len(self._places):
                    raise _AllFound
            return t

        arguments = self._arguments.grad_fn.saved_tensors
        hooks = torch.autograd.graph.saved_tensors_hooks(fill, lambda t: t)
        with contextlib.suppress(_AllFound), self._around(), torch.enable_grad(), hooks:
            self._function(*arguments)
        if found < len(self._places):
            raise RuntimeError(f"{CHANGED}: {len(self._places)} tensors the first time, then {found}")


CHANGED = "a recomputed function must save the same tensors for the backward pass"


def _kind(t: Tensor) -> tuple[Any, ...]:
    return t.shape, t.dtype, t.device


def _in_words(kind: tuple[Any, ...]) -> str:
    return f"{list(kind[0])} {kind[1]} on {kind[2]}"


def _random_state() -> Tensor:
    """State of the random numbers on the host, 5 KB; the tensor of the latest call where none were drawn since."""
    now = torch.get_rng_state()
    latest = _LATEST.get("state")
    if latest is None or not torch.equal(latest, now):
        _LATEST["state"] = now
        return now
    return latest


_LATEST: weakref.WeakValueDictionary[str, Tensor] = weakref.WeakValueDictionary()


def _surroundings(devices: set[torch.device]) -> Callable[[], contextlib.AbstractContextManager[None]]:
    """Random numbers, autocast and default device at present, to be restored later."""
    cuda = [device for device in devices if device.type == "cuda"]
    random = _random_state(), {device: torch.cuda.get_rng_state(device) for device in cuda}
    kinds = {kind for kind in {"cpu", *(d.type for d in devices)} if torch.amp.is_autocast_available(kind)}
    cast = [(kind, torch.get_autocast_dtype(kind), torch.is_autocast_enabled(kind)) for kind in kinds]
    caches = torch.is_autocast_cache_enabled()
    default = torch.get_default_device()

    @contextlib.contextmanager
    def around() -> Iterator[None]:
        with contextlib.ExitStack() as stack:
            stack.enter_context(torch.random.fork_rng(cuda))
            torch.set_rng_state(random[0])
            for device, kept in random[1].items():
                torch.cuda.set_rng_state(kept, device)
            for kind, dtype, enabled in cast:
                stack.enter_context(torch.autocast(kind, dtype, enabled, caches))
            if torch.get_default_device() != default:  # A mode slows down each operation.
                stack.enter_context(default)
            yield

    return around
