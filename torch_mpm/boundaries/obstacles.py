"""Rigid obstacles: shapes that act on the grid nodes inside them, and that may move."""

from __future__ import annotations

import math
import uuid
import weakref
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from ..cuda_graphs.capture import DeviceConstantCache
from ..errors import check_count, check_number, shape_of
from ..geometry import shapes, values
from ..geometry.per_scene import per_node
from ..geometry.shapes import Shape
from ..geometry.values import Value
from ..geometry.vectors import transform
from ..laws.parameters import tensors_in
from .motion import Path, Pose, RigidMotion, to_body
from .solid import SolidNodes, after_contact
from .walls import CONTACTS

if TYPE_CHECKING:
    from ..state.state import State
    from .control import Course


class Identity:
    """What an obstacle has in common with its copies, also with those of a pickle, one for each name."""

    _known: ClassVar[weakref.WeakValueDictionary[str, Identity]] = weakref.WeakValueDictionary()

    def __new__(cls, name: str) -> Identity:
        identity = cls._known.get(name)
        if identity is None:
            identity = cls._known[name] = super().__new__(cls)
            identity.name = name
        return identity

    name: str

    def __reduce__(self) -> tuple[type[Identity], tuple[str]]:
        return Identity, (self.name,)


class Obstacle(RigidMotion):
    """A rigid body that acts on the nodes inside it.

    `Plane`, `Sphere`, `Box`, `Capsule`, `Revolved` and `SDF` are obstacles of these shapes, made from its parameters;
    a parameter of the shape is an attribute of theirs too.

    At a node inside, the velocity relative to the surface there loses all of itself ("sticky"), its normal component
    ("slip"), or its normal component where it points into the body ("separate"). Coulomb friction then lowers the
    tangential speed by `friction` times the normal velocity that was stopped. In an inner edge or corner the node meets
    all faces that join there, and obstacles of a step act as one solid (docs/concepts.md). `forward` is that of the
    obstacle alone. A vibrating body needs more friction to
    stick than a rigid one (docs/limitations.md).

    Args:
        shape: see `torch_mpm.shapes`.
        position: centre (or a point of the plane) at time `start` [m], [D] or [B, D] in one of the forms below; or a
            function of the time, a tensor [], that returns one of them. Scenes with times of their own have the time
            [B]: a function that does not return [B, D] for it is called with the time [] of each scene.
        kind: "sticky", "slip" or "separate".
        friction: Coulomb coefficient ≥ 0, [] or [B].
        velocity: velocity of the centre [m/s], [D] or [B, D]. Not with a function as position, whose derivative by time
            is the velocity; where the derivative is zero, as of functions of numbers, its difference over a step.
        rotation: orientation at time `start` [rad]: an angle (2-D) or a rotation vector (3-D), about the centre.
        angular_velocity: constant [rad/s], in the same forms.
        start, end: the obstacle acts while start ≤ time < end [s].
        scene: it acts only in this scene of a batch; None for all.

    Parameters of shapes and obstacles have these forms, in a constructor, in an assignment, and as the result of a
    function: a number; a tensor or an array [], [B], [D] or [B, D]; a list or tuple of D components, which are numbers
    or arrays [] or [B], and are stacked on the last axis; a list of B lists of D numbers, [B, D]. So two arrays in a
    list are two components, and two lists in a list are two scenes. In the result of a function, components may be
    tensors too.

    All of these may be assigned between control steps: one is a call of a step, of `rollout`, `rollout_to` or
    `Environments.advance`, or the steps from one call of a hook to the next. A state stores where its steps have left
    each obstacle (`pose_in`). From there the obstacle continues in the next control step:

    - Without a velocity, an assigned `position` is where the centre is at the end of the control step. It moves there
      at the constant velocity of the change, which pushes, and then rests. So for `rotation` without an
      `angular_velocity`: it turns by the shortest turn.
    - An assigned `velocity` acts from where the centre is. A `position` that is assigned while a velocity is given is
      where the centre is at the beginning of the control step. It must be where it was left, within 1% of the way of
      the control step: otherwise the call raises on the CPU, and `Step.check` on CUDA. So for rotations.
    - In the first steps of a state that was made anew or read from a file, in scenes that `Environments.reset` has
      replaced, and after `place`, it is at its pose at once and pushes nothing on its way there.

    In a `rollout` of a function that is no module, each step is a control step. A step that was compiled by
    `torch.compile`, or captured in a CUDA graph by hand, places its obstacles: give them a velocity there.

    Tensors may require grad: the gradient of the node velocities goes to position, velocity, rotation,
    angular_velocity, friction and the directions of the shape, through the normal and the surface velocity; where a
    pose was assigned, to the poses before and after the change. Which nodes are inside is not differentiable, so radius
    and size have no gradient and refuse tensors that require one. An obstacle is a module: its tensors are buffers, or
    parameters where they are given as `nn.Parameter`. Nothing here synchronises with the device. Obstacles of a `Step`
    whose shapes the kernel knows act in it, see `torch_mpm.ops.contact`; the others by the torch operations here.

    Raises:
        TypeError, ValueError: for a wrong argument, also where it is assigned; shapes are checked at the first use, and
            values of tensors on other devices than the CPU are not read.
    """

    RANKS: ClassVar = {**RigidMotion.RANKS, "friction": 0}
    CHECKS: ClassVar = {**RigidMotion.CHECKS, "friction": values.friction}
    placed: Course | None = None
    """Course of the latest control step that began at the attributes, if these were numbers."""

    def __init__(
        self,
        shape: Shape,
        position: Value | Path,
        kind: str = "separate",
        friction: float | Tensor = 0.0,
        velocity: Value | None = None,
        rotation: Value | None = None,
        angular_velocity: Value | None = None,
        start: float = 0.0,
        end: float = math.inf,
        scene: int | None = None,
    ) -> None:
        if not isinstance(shape, Shape):
            raise TypeError(f"shape must be a shape of torch_mpm.shapes, got {shape_of(shape)}")
        if kind not in CONTACTS:
            raise ValueError(f"kind must be one of {sorted(CONTACTS)}, got {kind!r}")
        for name, value in (("start", start), ("end", end)):
            check_number(name, value, "a number", lambda v: v == v)
        if not (math.isfinite(start) and start <= end):
            raise ValueError(f"start must be finite and not after end, got start {start} and end {end}")
        if scene is not None:
            check_count("scene", scene)
        super().__init__(position, velocity, rotation, angular_velocity, start)
        self.shape, self.kind, self.friction = shape, kind, friction
        self.end, self.scene = float(end), scene
        self.kept_table = DeviceConstantCache()
        """Kept by `torch_mpm.ops.obstacle_tables` for a list of obstacles that begins with this one."""
        self.identify()
        self.placements = 0
        """How often it was placed."""
        self.course: Course | None = None
        """Motion in the current control step, see `boundaries.control`; None outside."""

    def __setattr__(self, name: str, value: Any) -> None:
        if isinstance(getattr(type(self), name, None), property):
            object.__setattr__(self, name, value)
        else:
            super().__setattr__(name, value)

    # -- control

    @property
    def key(self) -> weakref.ref[Identity]:
        """Of what a state stores about the obstacle; dead once the obstacle and its copies are gone."""
        return weakref.ref(self.identity)

    def identify(self) -> None:
        """Make it another obstacle than those that it was copied from."""
        self.identity = Identity(uuid.uuid4().hex)

    def place(self, position: Value | Path | None = None, rotation: Value | None = None) -> None:
        """Put the obstacle somewhere at once: it pushes nothing on its way there.

        Between control steps; in all scenes. (`Environments.reset` does so for the scenes that it resets.)

        Args:
            position, rotation: as for the constructor; None for those of now. With a velocity they are those at time
                `start`.

        Raises:
            TypeError, ValueError: for numbers that are not finite.
        """
        if position is not None:
            self.position = position
        if rotation is not None:
            self.rotation = rotation
        self.placements += 1

    def pose_in(self, state: State) -> Pose:
        """Where a state has left the obstacle, in the dtype of its particles; its pose at the time of the state if no
        step has moved the state yet."""
        left = state.poses.get(self.key)
        placed = left is None or left.placements != self.placements
        motion = self if placed or left is None else left.motion
        return motion.pose(state.time, state.x)

    def follow(self, course: Course | None, pace: float | Tensor) -> None:
        """Begin a control step with steps of `pace` [s]; None for its end."""
        vars(self)["course"], vars(self)["pace"] = course, pace  # not among the buffers
        control = None if course is None else course.during
        if control is None:
            self._modules.pop("control", None)
        else:
            vars(control)["pace"] = pace
            self._modules["control"] = control

    # -- interface of boundaries, which `apply` takes as `forward` does

    def apply(self, *arguments: Any, **named: Any) -> Any:
        """The node velocities of `forward`; of a function alone, what `nn.Module.apply` does."""
        if arguments and callable(arguments[0]):
            return super().apply(*arguments)
        return self(*arguments, **named)

    def forward(
        self, velocity: Tensor, positions: Tensor, scene: Tensor | None, time: float | Tensor, dt: float | Tensor
    ) -> Tensor:
        """Node velocities after contact.

        Args:
            velocity: node velocities [N, D] [m/s].
            positions: node positions [N, D] [m].
            scene: scene of each node, int32 [N] (negative: none), or None for one scene.
            time: [s], a number or a tensor [] or [B].
            dt: time step [s]; for boundaries that need one.

        Returns:
            Velocities [N, D] [m/s].

        Raises:
            ValueError: for wrong shapes or devices.
        """
        if velocity.dim() != 2 or velocity.shape != positions.shape:
            raise ValueError(
                "velocity and positions must both have shape [N, D], "
                f"got {shape_of(velocity)} and {shape_of(positions)}"
            )
        if positions.shape[0] == 0 or self.is_absent(scene, time):
            return velocity
        after, _ = after_contact(velocity, SolidNodes([self], [None], positions, scene, time, None))
        return after

    # -- surfaces, as contact of several obstacles looks at them

    def surface_at(self, x: Tensor, scene: Tensor | None, time: float | Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance [N] [m] and outward normal [N, D] at points of the world; other arguments as `forward`."""
        arm, turn = self._arm_and_turn(x, scene, time)
        distance, normal = self.shape.surface(to_body(turn, arm), scene)
        return distance, normal if turn is None else transform(turn, normal)

    def faces_at(self, x: Tensor, scene: Tensor | None, time: float | Tensor) -> shapes.Faces | None:
        """`Shape.surface_faces` at points of the world."""
        if type(self.shape).surface_faces is Shape.surface_faces:
            return None
        arm, turn = self._arm_and_turn(x, scene, time)
        found = self.shape.surface_faces(to_body(turn, arm), scene)
        if found is None or turn is None:
            return found
        return found._replace(normal=found.normal @ turn.mT)

    def height_of_face(
        self, x: Tensor, face: Tensor, scene: Tensor | None, time: float | Tensor
    ) -> tuple[Tensor, Tensor]:
        """Height of points above a face of each, int64 [N], and the normal there; −1 for the whole surface."""
        height, normal = self.surface_at(x, scene, time)
        found = self.faces_at(x, scene, time)
        if found is None or found.height.shape[1] == 1:
            return height, normal
        index = face.clamp(0, found.height.shape[1] - 1)[:, None]
        own = found.normal.gather(1, index[:, :, None].expand(-1, 1, x.shape[1]))[:, 0]
        whole = face < 0
        return torch.where(whole, height, found.height.gather(1, index)[:, 0]), torch.where(whole[:, None], normal, own)

    def turned(self, body: Tensor, scene: Tensor | None, time: float | Tensor) -> Tensor:
        """Vectors of the body [N, D] in the world."""
        turn = self.rotation_at(time, body, body.shape[1])
        return body if turn is None else transform(per_node(turn, 2, scene), body)

    def matter_velocity(self, x: Tensor, scene: Tensor | None, time: float | Tensor) -> Tensor | None:
        """Velocity of the body's matter at points of the world [N, D] or [D] [m/s]; None at rest."""
        return self.velocity_at(x - per_node(self.centre_at(time, x), 1, scene), scene, time)

    def _arm_and_turn(
        self, positions: Tensor, scene: Tensor | None, time: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Positions from the centre [N, D] [m]; the rotation [D, D] or [N, D, D], None where the body never turns."""
        dim = positions.shape[1]
        centre, turn = self.centre_at(time, positions), self.rotation_at(time, positions, dim)
        if centre.shape[-1] != dim:
            raise ValueError(f"position must have {dim} numbers per point, got {shape_of(centre)}")
        arm = positions - per_node(centre, 1, scene)
        return arm, None if turn is None else per_node(turn, 2, scene)

    def check_scenes(self, dim: int, scenes: int) -> None:
        super().check_scenes(dim, scenes)
        self.shape.check_scenes(dim, scenes)
        if self.scene is not None and self.scene >= scenes:
            raise ValueError(f"scene must be below B = {scenes}, got {self.scene}")

    # -- as a region

    def contains(self, positions: Tensor, scene: Tensor | None, time: float | Tensor) -> Tensor:
        """Which positions are inside, bool [N]; arguments as `forward`."""
        return self._inside(self.signed_distance(positions, scene, time), positions)

    def signed_distance(self, positions: Tensor, scene: Tensor | None, time: float | Tensor) -> Tensor:
        """Distance of positions from the surface [N] [m], negative inside; infinite while the obstacle is not there.

        Arguments as `forward`. Differentiable; true near the surface, and away from it where the shape allows.
        """
        if positions.shape[0] == 0 or self.is_absent(scene, time):
            return positions.new_full(positions.shape[:1], torch.inf)
        arm, turn = self._arm_and_turn(positions, scene, time)
        distance = self.shape.signed_distance(to_body(turn, arm), scene)
        present = self._present(scene, time)
        return distance if present is None else torch.where(present, distance, torch.inf)

    def speed(self, positions: Tensor, scene: Tensor | None, time: float | Tensor, reach: float) -> Tensor:
        """Speed of the body's matter at positions no further than `reach` [m] outside, else zero [N] [m/s].

        Other arguments as `apply`.
        """
        velocity = None
        if positions.shape[0] and not self.is_absent(scene, time):
            arm = positions - per_node(self.centre_at(time, positions), 1, scene)
            velocity = self.velocity_at(arm, scene, time)
        if velocity is None:
            return positions.new_zeros(positions.shape[:1])
        near = self.signed_distance(positions, scene, time) <= reach
        return torch.where(near, velocity.norm(dim=-1), 0)

    # -- when and where it is there

    @property
    def reads_time(self) -> bool:
        """Whether it moves, or comes or goes after the time zero."""
        return self.moves or self.start != 0 or self.end != math.inf

    def is_absent(self, scene: Tensor | None, time: float | Tensor) -> bool:
        """Whether it is nowhere, as far as that is known without reading a tensor; arguments as `forward`."""
        if scene is None and self.scene not in (None, 0):
            return True
        return not isinstance(time, Tensor) and not self.start <= time < self.end

    def _present(self, scene: Tensor | None, time: float | Tensor) -> Tensor | None:
        """The nodes for which the obstacle is there, bool [N] or []; None for all."""
        present = None
        if self.scene is not None and scene is not None:
            present = scene == self.scene
        if isinstance(time, Tensor):
            begun = time >= self.start
            now = per_node(begun if self.end == math.inf else begun & (time < self.end), 0, scene)
            present = now if present is None else present & now
        return present

    def _touching(self, distance: Tensor, positions: Tensor, scene: Tensor | None, time: float | Tensor) -> Tensor:
        """Which nodes are inside, bool [N]."""
        inside, present = self._inside(distance, positions), self._present(scene, time)
        return inside if present is None else inside & present

    def _inside(self, distance: Tensor, positions: Tensor) -> Tensor:
        """Which distances are not outside; a node on the surface to rounding counts as inside."""
        if positions.shape[0] == 0:
            return torch.zeros_like(distance, dtype=torch.bool)
        rounding = 16 * torch.finfo(positions.dtype).eps
        return distance.detach() <= rounding * positions.detach().abs().amax()


def motion_tensors(obstacle: Obstacle) -> list[Tensor]:
    """The tensors of an obstacle: of its shape, where it is and how it moves."""
    values = (*vars(obstacle).values(), *vars(obstacle.shape).values())
    return [v for v in values if isinstance(v, Tensor)] + tensors_in(obstacle)


# ---- obstacles of one shape each


def _of_shape(name: str) -> Any:
    """A parameter of the shape as an attribute of the obstacle."""
    return property(lambda self: getattr(self.shape, name), lambda self, value: setattr(self.shape, name, value))


class Plane(Obstacle):
    """A half-space: everything behind a plane through `position`.

    Args:
        normal: direction out of the half-space, into the material: D numbers, or a tensor [D] or [B, D] that may
            require grad; of any length but zero.
        position, kind, friction, velocity, rotation, angular_velocity, start, end, scene: see `Obstacle`.
    """

    normal = _of_shape("normal")

    def __init__(self, position: Value | Path, normal: Value, kind: str = "separate", **motion: Any) -> None:
        super().__init__(shapes.Plane(normal), position, kind, **motion)


class Sphere(Obstacle):
    """A ball; a disc in 2-D.

    Args:
        radius: [m], a number, or a tensor [] or [B].
        position, kind, friction, velocity, rotation, angular_velocity, start, end, scene: see `Obstacle`.
    """

    radius = _of_shape("radius")

    def __init__(self, position: Value | Path, radius: float | Tensor, kind: str = "separate", **motion: Any) -> None:
        super().__init__(shapes.Sphere(radius), position, kind, **motion)


class Box(Obstacle):
    """A box with edges along its own axes.

    Args:
        size: edge lengths [m]: D numbers, or a tensor [D] or [B, D].
        position, kind, friction, velocity, rotation, angular_velocity, start, end, scene: see `Obstacle`.
    """

    size = _of_shape("size")

    def __init__(self, position: Value | Path, size: Value, kind: str = "separate", **motion: Any) -> None:
        super().__init__(shapes.Box(size), position, kind, **motion)


class Capsule(Obstacle):
    """All points within `radius` of a segment.

    Args:
        half_axis: from the centre to one end of the segment [m]: D numbers, or a tensor [D] or [B, D] that may require
            grad. The other end is opposite.
        radius: [m], a number, or a tensor [] or [B].
        position, kind, friction, velocity, rotation, angular_velocity, start, end, scene: see `Obstacle`.
    """

    half_axis, radius = _of_shape("half_axis"), _of_shape("radius")

    def __init__(
        self,
        position: Value | Path,
        half_axis: Value,
        radius: float | Tensor,
        kind: str = "separate",
        **motion: Any,
    ) -> None:
        super().__init__(shapes.Capsule(half_axis, radius), position, kind, **motion)


class Revolved(Obstacle):
    """A polygon turned about an axis: a cone, a tube, a funnel, an hourglass, a drum.

    In 2-D, the polygon and its mirror image. A wall should be at least 4 cells thick, and reach 3 cells beyond an open
    face of the domain where it meets one: nodes outside carry momentum too.

    Args:
        outline: corners of the polygon, K pairs of distance from the axis (≥ 0) and position along it [m], counted from
            `position`; not crossing itself.
        axis: direction of the axis: D numbers, or a tensor [D] or [B, D] that may require grad; y by default.
        position, kind, friction, velocity, rotation, angular_velocity, start, end, scene: see `Obstacle`.
    """

    outline, axis = _of_shape("outline"), _of_shape("axis")

    def __init__(
        self,
        position: Value | Path,
        outline: Sequence[Sequence[float]],
        axis: Value | None = None,
        kind: str = "separate",
        **motion: Any,
    ) -> None:
        super().__init__(shapes.Revolved(outline, axis), position, kind, **motion)


class SDF(Obstacle):
    """Any shape, from its signed distance.

    Args:
        distance: function of body coordinates [N, D] [m], x − position turned back, that returns distances [N] [m],
            negative inside. Torch operations; it need not be exact away from its zero level. Of `shapes.Sampled.of` it
            becomes a shape that acts in the kernel.
        normal: function of the same coordinates that returns outward normals [N, D]; None for the gradient of
            `distance` by automatic differentiation. Of any length; where it is zero, nodes are left alone.
        position, kind, friction, velocity, rotation, angular_velocity, start, end, scene: see `Obstacle`.
    """

    distance, normal = _of_shape("distance"), _of_shape("normal")

    def __init__(
        self,
        distance: Callable[[Tensor], Tensor],
        position: Value | Path,
        kind: str = "separate",
        normal: Callable[[Tensor], Tensor] | None = None,
        **motion: Any,
    ) -> None:
        super().__init__(shapes.SDF(distance, normal), position, kind, **motion)
