"""Control steps: motion of obstacles whose pose or velocity was assigned between two calls of a step.

A control step is one call of a step, of `rollout` or of `Environments.advance`, or the steps between two hooks. A state
stores the poses of the obstacles after its steps, so that a call is a function of its arguments. An obstacle moves
from the stored pose to the assigned one at constant rates, and reaches it at the end of the call. No function here
synchronises.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import math
import threading
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from ..cuda_graphs.capture import Remembered, as_remembered, is_captured, is_same, is_traced
from ..geometry.values import filled
from ..geometry.vectors import composed, norm
from ..ops.arguments import check_kind_of_dt
from .motion import PACE, RigidMotion

if TYPE_CHECKING:
    from ..state.state import State
    from .obstacles import Obstacle

ASSIGNED = ("position", "velocity", "rotation", "angular_velocity")
SLACK = 0.01
"""Tolerance of a pose against the result of a given velocity, as a fraction of the motion in the control step."""


class Left(NamedTuple):
    """Pose and motion of an obstacle that are stored in a state.

    Attributes:
        given: the attributes of the obstacle, in a form that detects changes.
        placements: number of times that it was placed.
        values: copies of the attributes, and `start` and `end`.
        moves: its motion from here on; None for that of its attributes.
        arrives: whether it may not have reached an assigned pose yet, in a scene that was paused.
        known: scenes with a stored pose, bool [B]; in others it is placed at its attributes. None for all.
    """

    given: tuple[Any, ...]
    placements: int
    values: tuple[Any, ...]
    moves: RigidMotion | None = None
    arrives: bool = False
    known: Tensor | None = None

    @property
    def motion(self) -> RigidMotion:
        """Motion from here on."""
        return _motion(self.values) if self.moves is None else self.moves

    def map(self, function: Callable[[Tensor], Tensor]) -> Left:
        """The same with a function applied to all tensors."""

        def mapped(values: Sequence[Any]) -> tuple[Any, ...]:
            return tuple(function(v) if isinstance(v, Tensor) else v for v in values)

        moves = None if self.moves is None else _motion(mapped(_values(self.moves)))
        return self._replace(values=mapped(self.values), moves=moves)

    def to(self, device: torch.device) -> Left:
        """Copy on another device."""
        left = self.map(lambda t: t.to(device))
        return left if self.known is None else left._replace(known=self.known.to(device))

    def copied(self, memo: dict[int, Any]) -> Left:
        """Copy for a deep copy, in which the obstacle may have been copied before."""
        given = tuple(
            copy.deepcopy(value, memo) if isinstance(value, Remembered) else memo.get(id(value), value)
            for value in self.given
        )
        return self._replace(given=given)

    def without(self, scenes: Tensor) -> Left:
        """The same, without stored poses in some scenes, bool [B]."""
        return self._replace(known=~scenes if self.known is None else self.known & ~scenes)


Poses = dict[weakref.ref[Any], Left]
"""Stored poses by `Obstacle.key`."""


@dataclasses.dataclass(frozen=True, eq=False)
class Course:
    """An obstacle in a control step.

    Attributes:
        during: motion in the control step; None for that of its attributes.
        after: pose and motion to store afterwards.
        contradicts: scenes in which its pose differs from the result of its velocity, bool [] or [B]; None for none.
    """

    during: RigidMotion | None
    after: Left
    contradicts: Tensor | None = None


class Span(NamedTuple):
    """Start, duration and step length of a control step [s]: numbers, or tensors [] or [B]."""

    begin: float | Tensor
    seconds: float | Tensor
    pace: float | Tensor


class _Thread(threading.local):
    steady = False


_THREAD = _Thread()


@contextlib.contextmanager
def steady() -> Iterator[None]:
    """Context in which steps inside a control step assign no obstacle; its tensors may be replaced by others."""
    before, _THREAD.steady = _THREAD.steady, True
    try:
        yield
    finally:
        _THREAD.steady = before


Leave = Callable[[Any], Any]
"""Function that stores the poses of obstacles in the state after a control step."""


def control_step(
    step: Any, state: State, n: int, dt: float | Tensor, seconds: float | Tensor | None = None
) -> contextlib.AbstractContextManager[Leave]:
    """A context in which obstacles move as they do in n steps from a state.

    A step inside another control step is a separate control step only for obstacles whose attributes were assigned in
    the meantime, for example by `on_particles`.

    Args:
        step: a `Step`, or a module that contains some. For another function each step is a control step.
        state: the state at the beginning.
        n, dt: as `rollout`.
        seconds: duration of the steps [s], if that is not n dt.

    Raises:
        TypeError: for a dt that is neither a number nor a tensor.
        ValueError: on the CPU, where a velocity contradicts the change of a pose. On CUDA the status counts it.
    """
    obstacles = [] if n == 0 or torch.compiler.is_compiling() or _THREAD.steady else obstacles_of(step)
    if not obstacles or is_traced(state.x) or is_captured(state.x):
        return _NO_CONTROL
    _tell_apart(obstacles)
    if _nothing_new(obstacles, state.poses):
        return _NO_CONTROL
    if any(o.course is not None for o in obstacles):
        return _inside(step, obstacles, state, dt)
    check_kind_of_dt(dt)
    return _control_step(step, obstacles, state, Span(state.time, n * dt if seconds is None else seconds, dt))


def _tell_apart(obstacles: Sequence[Obstacle]) -> None:
    """Give copies of obstacles in the same step keys of their own."""
    known = set()
    for obstacle in obstacles if len(obstacles) > 1 else ():
        if obstacle.identity in known:
            obstacle.identify()
        known.add(obstacle.identity)


def _nothing_new(obstacles: Sequence[Obstacle], poses: Poses) -> bool:
    """Whether no obstacle follows a path or has another motion than in the previous steps."""
    for obstacle in obstacles:
        course: Course | None = vars(obstacle)["course"]
        left = poses.get(obstacle.key) if course is None else course.after
        if left is None or left.known is not None or (course is None and (left.moves is not None or left.arrives)):
            return False
        if "position" in obstacle._modules or callable(vars(obstacle).get("position")):
            return False
        if not _is_as_left(obstacle, left):
            return False
    return True


@contextlib.contextmanager
def _inside(step: Any, obstacles: Sequence[Obstacle], state: State, dt: float | Tensor) -> Iterator[Leave]:
    """A step inside a control step. If it fails, obstacles are restored."""
    span = Span(state.time, dt, dt)
    before = [(o, o.course) for o in obstacles if o.course is not None]
    changed = {
        k: course_of(o, _underway(o.course), span, state.x.device)
        for k, o in enumerate(obstacles)
        if o.course is not None and not _is_as_left(o, o.course.after)
    }
    _report(step, obstacles, changed)
    try:
        for k, course in changed.items():
            obstacles[k].follow(course, dt)
        for obstacle, _ in before:
            if obstacle.pace is not dt:
                obstacle.follow(obstacle.course, dt)
        yield _unchanged
    except BaseException:
        for obstacle, was in before:
            obstacle.follow(was, dt)
        raise
    for k, course in changed.items():
        obstacles[k].follow(Course(course.after.moves, course.after), dt)


def motions_now(step: Any, state: State) -> Callable[[], contextlib.AbstractContextManager[None]]:
    """Factory of a context in which obstacles keep their present motion if their attributes are assigned inside a step:
    the assignment acts in the next control step."""
    fixed = _THREAD.steady or is_traced(state.x) or is_captured(state.x)
    now = [] if fixed else [(o, _left_at(o)) for o in obstacles_of(step) if o.motion is o]

    @contextlib.contextmanager
    def held() -> Iterator[None]:
        changed = [(o, left.motion) for o, left in now if not _is_as_left(o, left)]
        for obstacle, motion in changed:
            vars(motion)["pace"] = obstacle.pace
            obstacle._modules["control"] = motion
        try:
            yield
        finally:
            for obstacle, _ in changed:
                obstacle._modules.pop("control", None)

    return held


@contextlib.contextmanager
def _control_step(step: Any, obstacles: Sequence[Obstacle], state: State, span: Span) -> Iterator[Leave]:
    poses, device = state.poses, state.x.device
    courses = [course_of(o, poses.get(o.key), span, device) for o in obstacles]
    if any([course.contradicts is not None for course in courses]):
        _report(step, obstacles, dict(enumerate(courses)))
    try:
        for obstacle, course in zip(obstacles, courses, strict=True):
            obstacle.follow(course, span.pace)
        yield lambda state: _leave(state, obstacles)
    finally:
        for obstacle in obstacles:
            obstacle.follow(None, PACE)


def motions_of(step: Any, poses: Poses) -> Callable[[], contextlib.AbstractContextManager[None]]:
    """Factory of a context with the present motions of obstacles in steps from a state with these poses, for a backward
    pass that recomputes these steps."""
    now = [(o, _Motions(o).stored(o, poses)) for o in obstacles_of(step)]

    @contextlib.contextmanager
    def again() -> Iterator[None]:
        with restored([o for o, _ in now]):
            for obstacle, motions in now:
                motions.give(obstacle)
            yield

    return again


@contextlib.contextmanager
def restored(obstacles: Sequence[Obstacle]) -> Iterator[None]:
    """Context after which obstacles have the attributes and the control step that they had before."""
    before = [(o, _Motions(o)) for o in obstacles]
    try:
        yield
    finally:
        for obstacle, motions in before:
            motions.give(obstacle)


class _Motions:
    """The attributes and the control step of an obstacle, for a later restoration."""

    def __init__(self, obstacle: Obstacle) -> None:
        self._plain = {name: vars(obstacle)[name] for name in (*ASSIGNED, "course", "pace") if name in vars(obstacle)}
        self._stored = {name: dict(vars(obstacle)[name]) for name in ("_parameters", "_buffers", "_modules")}

    def stored(self, obstacle: Obstacle, poses: Poses) -> _Motions:
        """Copy that later writes do not change. Values that were identical to the stored ones stay identical."""
        course: Course | None = self._plain["course"]
        left = poses.get(obstacle.key) if course is None else course.after
        same = [] if left is None else _sameness(obstacle, left)
        for name in ("_parameters", "_buffers"):
            self._stored[name] = {key: None if t is None else t.clone() for key, t in self._stored[name].items()}
        if left is not None:
            values = [next((d[n] for d in (self._plain, *self._stored.values()) if n in d), None) for n in ASSIGNED]
            given = tuple(
                as_remembered(value) if known else before
                for known, value, before in zip(same, values, left.given, strict=True)
            )
            during = None if course is None else course.during
            self._plain["course"] = Course(during, left._replace(given=given))
        return self

    def give(self, obstacle: Obstacle) -> None:
        for name in ASSIGNED:
            vars(obstacle).pop(name, None)
        vars(obstacle).update(self._plain)
        for name, values in self._stored.items():
            vars(obstacle)[name].clear()
            vars(obstacle)[name].update(values)


def obstacles_of(step: Any) -> Sequence[Obstacle]:
    """Obstacles of a `Step` and of its heat, or of a module that contains steps."""
    Step, Obstacle = _classes()
    if not isinstance(step, torch.nn.Module):
        return []
    if not isinstance(step, Step):
        return _obstacles_in(step, set())
    entries = step._modules["boundaries"].entries  # Attributes of modules take longer.
    if len(step._modules) == 2 and all([isinstance(b, Obstacle) for b in entries]):  # the law and the boundaries
        return entries if len(entries) < 2 else list(dict.fromkeys(entries))  # one may stand in the list twice
    parts = [part for name, part in step._modules.items() if name != "law" and part is not None]
    seen: set[int] = set()
    return [obstacle for part in parts for obstacle in _obstacles_in(part, seen)]


def _obstacles_in(module: Any, seen: set[int]) -> list[Obstacle]:
    """Obstacles among a module and those inside it. Modules whose ids are in `seen` are skipped, and those found are
    added. `nn.Module.modules` takes longer than the kernels of a small scene.
    """
    if id(module) in seen:
        return []
    seen.add(id(module))
    found = [module] if isinstance(module, _classes()[1]) else []
    for inner in module._modules.values():
        if inner is not None:
            found += _obstacles_in(inner, seen)
    return found


@functools.cache
def _classes() -> tuple[Any, Any]:
    """Classes of modules that import this one."""
    from ..step.step import Step
    from .obstacles import Obstacle

    return Step, Obstacle


def _unchanged(state: State) -> State:
    return state


_NO_CONTROL = contextlib.nullcontext(_unchanged)


def _underway(course: Course) -> Left:
    """Pose of an obstacle to store in the middle of a control step."""
    if course.during is None:
        return course.after
    return course.after._replace(moves=course.during, arrives=False)


def _leave(state: State, obstacles: Sequence[Obstacle]) -> State:
    """A state with the poses of its obstacles."""
    before = state.poses
    poses = {key: left for key, left in before.items() if key() is not None}
    for obstacle in obstacles:
        assert obstacle.course is not None
        poses[obstacle.key] = obstacle.course.after
    same = len(poses) == len(before) and all([before.get(key) is left for key, left in poses.items()])
    return state if same else state.with_poses(poses)


def _report(step: Any, obstacles: Sequence[Obstacle], courses: Mapping[int, Course]) -> None:
    """Raise on the CPU, or count, velocities that contradict the change of a pose, by the number of the obstacle."""
    for k, course in courses.items():
        wrong = course.contradicts
        if wrong is None:
            continue
        if not wrong.is_cpu:
            _count(step, wrong)
        elif bool(wrong.any()):
            scenes = f" in scenes {wrong.nonzero().flatten().tolist()}" if wrong.dim() else ""
            name = type(obstacles[k]).__name__
            raise ValueError(
                f"obstacle {k} ({name}) is not where its velocity has led it{scenes}: a position or rotation that is "
                "assigned while a velocity is given is the pose at the beginning of the call. Set "
                "velocity and angular_velocity to None, and it moves to an assigned pose with the velocity of the "
                "change; or use `Obstacle.place`, which moves it at once and pushes nothing"
            )


def _count(step: Any, wrong: Tensor) -> None:
    for module in step.modules():
        status = getattr(module, "_error_status", None)
        if status is not None and hasattr(module, "grid"):  # a `Step` or a `Heat`
            status.contradict(wrong, module.grid.scenes)


# ---- one obstacle


def course_of(obstacle: Obstacle, left: Left | None, span: Span, device: torch.device) -> Course:
    """Course of an obstacle in a control step, from its stored pose; None without one."""
    if left is None or left.placements != obstacle.placements:
        return _placed(obstacle)
    same = _sameness(obstacle, left)
    if all(same) and not left.arrives and (left.moves is None or left.known is None):
        return Course(left.moves, left if left.known is None else left._replace(known=None))
    later = _left_at(obstacle)
    changes = _Changes(left, span, obstacle.start, device)
    centre, rotation = (
        _part(turns, obstacle, later, changes, same[2 * turns : 2 * turns + 2]) for turns in (False, True)
    )
    frame = obstacle.start, obstacle.end
    during = _motion((*centre.during, *rotation.during, *frame))
    own, arrives = centre.own and rotation.own, centre.arrives or rotation.arrives
    after = None if own else _motion((*centre.after, *rotation.after, *frame))
    wrong = [part.contradicts for part in (centre, rotation) if part.contradicts is not None]
    contradicts = None if not wrong else wrong[0] if len(wrong) == 1 else wrong[0] | wrong[1]
    return Course(during, later._replace(moves=after, arrives=arrives), contradicts)


def _placed(obstacle: Obstacle) -> Course:
    """Course of an obstacle that begins at its attributes; the same object while these are the same numbers."""
    latest = obstacle.placed
    if latest is not None and _is_as_left(obstacle, latest.after):
        if latest.after.values[len(ASSIGNED) :] == (obstacle.start, obstacle.end):
            return latest
    course = Course(None, _left_at(obstacle))
    of_tensors = any([isinstance(value, Tensor) for value in course.after.values])
    vars(obstacle)["placed"] = None if of_tensors else course  # Copies of tensors belong to a graph or to inference.
    return course


def _left_at(obstacle: Obstacle) -> Left:
    """An obstacle at the pose of its attributes."""
    values = _assigned(obstacle)
    copies = [
        value.clone() if isinstance(value, Tensor) else obstacle.value_of(name)
        for name, value in zip(ASSIGNED, values, strict=True)
    ]
    given = tuple(as_remembered(value) for value in values)
    return Left(given, obstacle.placements, (*copies, obstacle.start, obstacle.end))


def _values(motion: RigidMotion) -> tuple[Any, ...]:
    return *_assigned(motion), motion.start, motion.end


def _motion(values: Sequence[Any]) -> RigidMotion:
    """Motion with the values of `_values`, without its constructor: attributes of modules take microseconds each."""
    *assigned, start, end = values
    motion = RigidMotion.__new__(RigidMotion)
    for name, value in zip(ASSIGNED, assigned, strict=True):
        of_modules = motion._modules if isinstance(value, torch.nn.Module) else vars(motion)
        (motion._buffers if isinstance(value, Tensor) else of_modules)[name] = value
    vars(motion).update(start=start, end=end, pace=PACE)
    if callable(assigned[0]):
        vars(motion)["velocity"] = None
    return motion


def _assigned(motion: RigidMotion) -> tuple[Any, ...]:
    """Attributes that define the motion. Read from dictionaries: `getattr` of a buffer takes a microsecond."""
    plain, buffers, parameters = vars(motion), motion._buffers, motion._parameters
    values = [
        plain[name]
        if name in plain
        else buffers[name]
        if name in buffers
        else parameters[name]
        if name in parameters
        else motion._modules[name]
        for name in ASSIGNED
    ]
    return tuple(values)


def _sameness(obstacle: Obstacle, left: Left) -> list[bool]:
    """Whether each attribute is unchanged."""
    return [is_same(known, value) for known, value in zip(left.given, _assigned(obstacle), strict=True)]


def _is_as_left(obstacle: Obstacle, left: Left) -> bool:
    return left.placements == obstacle.placements and is_same(left.given, _assigned(obstacle))


class _Part(NamedTuple):
    """The centre or the rotation of an obstacle: its pose at `start` and its rate, in a control step and after it.

    `own` states whether the latter are the attributes; `arrives` and `contradicts` are as in `Left` and `Course`.
    """

    during: tuple[Any, Any]
    after: tuple[Any, Any]
    own: bool = True
    arrives: bool = False
    contradicts: Tensor | None = None


def _part(turns: bool, obstacle: Obstacle, later: Left, changes: _Changes, same: Sequence[bool]) -> _Part:
    """The part of the centre, or of the rotation."""
    own, before = later.values[2 * turns : 2 * turns + 2], _values(changes.before)[2 * turns : 2 * turns + 2]
    if all(value is None for value in (*own, *before)):
        return _Part(own, own)
    changes.turns, arrives = turns, changes.left.arrives
    if all(same) and not arrives:
        return _Part(own, own) if changes.left.moves is None else changes.of_known(_Part(before, before, False), own)
    if callable(own[0]):
        return _Part(own, own, contradicts=changes.jump(changes.on_path(obstacle), None))
    if same[0] and not arrives:
        pair = changes.backwards(changes.pose(), own[1]), own[1]
        return changes.of_known(_Part(pair, pair, False), own)
    if own[1] is None:
        return changes.of_known(changes.to(own[0]), own)
    pair = changes.backwards(changes.value(own[0]), own[1]), own[1]
    return changes.of_known(_Part(pair, pair, False, contradicts=changes.jump(changes.value(own[0]), own[1])), own)


class _Changes:
    """Arithmetic of the poses of one obstacle in a control step, in float64.

    Centres [D] or [B, D]; angles [] or [B]; rotation vectors [3] or [B, 3].

    Args:
        left: stored pose and motion of the obstacle.
        span: the control step.
        start: time at which a pose is given, and from which its rate counts [s].
        device: of the particles.

    Attributes:
        before: motion of the obstacle so far.
        turns: whether the poses are rotations, not centres.
    """

    def __init__(self, left: Left, span: Span, start: float, device: torch.device) -> None:
        self.left, self._span, self.before, self.turns = left, span, left.motion, False
        self.like = torch.empty(0, dtype=torch.float64, device=device)
        self._elapsed, self._seconds = self._time(span.begin) - start, self._time(span.seconds)
        self._centre = self.before.centre_at(span.begin, self.like)
        self._dim = self._centre.shape[-1]

    @property
    def _rank(self) -> int:
        return 0 if self.turns and self._dim == 2 else 1

    def value(self, value: Any) -> Tensor:
        """A pose or a rate as a tensor; None for zero."""
        if value is None:
            return self.like.new_zeros((self._dim,) * self._rank)
        return value.to(self.like) if isinstance(value, Tensor) else filled(value, self.like)

    def pose(self) -> Tensor:
        """Stored pose of the obstacle."""
        if not self.turns:
            return self._centre
        turn = self._times(self.value(self.before.angular_velocity), self._elapsed)
        return self._moved(self.value(self.before.rotation), turn)

    def on_path(self, obstacle: Obstacle) -> Tensor:
        """First point of the path of an obstacle."""
        return _motion(_values(obstacle)).centre_at(self._span.begin, self.like)

    def backwards(self, pose: Tensor, rate: Any) -> Tensor:
        """Pose at `start`, from the pose at the beginning of the control step."""
        return pose if rate is None else self._moved(pose, self._times(self.value(rate), -self._elapsed))

    def to(self, target: Any) -> _Part:
        """Uniform motion to a pose, which is reached at the end."""
        pose, end = self.pose(), self.value(target)
        lasts = self._seconds > 0
        share = torch.where(lasts, 1 / torch.where(lasts, self._seconds, 1.0), 0.0)
        rate = self._times(self._way(pose, end), share)
        during = self.backwards(pose, rate), rate
        if not isinstance(self._span.seconds, Tensor):
            return _Part(during, (target, None))
        return _Part(during, (torch.where(self._column(lasts), end, pose), None), False, True)

    def jump(self, pose: Tensor, rate: Any) -> Tensor:
        """Scenes in which a pose differs from the stored one, bool [] or [B]."""
        before = self.pose()
        way = self._size(self._times(self.value(rate), self._seconds))
        rounding = 64 * torch.finfo(torch.float32).eps * (self._size(pose) + self._size(before))
        jumps = self._size(self._way(before, pose)) > SLACK * way + rounding
        return jumps if self.left.known is None else jumps & self.left.known

    def of_known(self, part: _Part, own: tuple[Any, Any]) -> _Part:
        """A part in the scenes with a stored pose of the obstacle; in others that of its attributes."""
        known = self.left.known
        if known is None:
            return part

        def pair(values: tuple[Any, Any]) -> tuple[Any, Any]:
            pose, rate = (
                torch.where(self._column(known), self.value(a), self.value(b)) for a, b in zip(values, own, strict=True)
            )
            return pose, rate

        return part._replace(during=pair(part.during), after=part.after if part.own else pair(part.after))

    def _time(self, time: float | Tensor) -> Tensor:
        if isinstance(time, Tensor):
            return time.to(self.like)
        return torch.full((), time, dtype=torch.float64, device=self.like.device)

    def _column(self, per_scene: Tensor) -> Tensor:
        """[] or [B] as a factor of poses."""
        return per_scene[..., None] if self._rank and per_scene.dim() else per_scene

    def _times(self, rate: Tensor, time: Tensor) -> Tensor:
        return rate * self._column(time)

    def _moved(self, pose: Tensor, way: Tensor) -> Tensor:
        return composed(way, pose) if self.turns and self._rank else pose + way

    def _way(self, begin: Tensor, end: Tensor) -> Tensor:
        """Displacement from one pose to another; for rotations the shortest one."""
        if not self.turns:
            return end - begin
        if self._rank:
            return composed(end, -begin)
        way = end - begin
        return way - 2 * math.pi * (way / (2 * math.pi)).round()

    def _size(self, way: Tensor) -> Tensor:
        return norm(way) if self._rank else way.abs()
