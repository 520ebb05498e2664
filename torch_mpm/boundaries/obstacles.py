"""Rigid bodies that act on the grid nodes inside them, and that may move."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.graph import saved_tensors_hooks

from ..capture import GraphCache
from ..errors import check_count, check_number, shape_of
from ..parameters import TensorModule
from ..reference.contact import contact_change
from .walls import CONTACTS

Value = float | Sequence[float] | Tensor
Motion = Callable[[Tensor], Tensor]


class Pose(NamedTuple):
    """Where an obstacle is: world = centre + rotation @ body."""

    centre: Tensor  # [D] or [B, D]
    rotation: Tensor  # [D, D] or [B, D, D]


class Obstacle(TensorModule):
    """A rigid body that acts on the nodes inside it. The base of `Plane`, `Sphere`, `Box`, `Capsule` and `SDF`.

    At a node inside, the velocity relative to the surface there loses all of itself ("sticky"), its normal component
    ("slip"), or its normal component where it points into the body ("separate"). Coulomb friction then lowers the
    tangential speed by `friction` times the normal velocity that was stopped. A vibrating body needs more friction to
    stick than a rigid one (docs/limitations.md).

    Args:
        position: centre (or a point of the plane) at time `start` [m]: D numbers, a tensor [D] or [B, D], or a function
            of the time, a tensor [] or [B], that returns such a tensor.
        kind: "sticky", "slip" or "separate".
        friction: Coulomb coefficient ≥ 0: a number, or a tensor [] or [B].
        velocity: velocity of the centre [m/s], constant: D numbers, or a tensor [D] or [B, D]. Not with a function as
            position, whose derivative by time is the velocity.
        rotation: orientation at time `start` [rad]: an angle (2-D) or a rotation vector (3-D), about the centre.
        angular_velocity: constant [rad/s], in the same forms.
        start, end: the obstacle acts while start ≤ time < end [s].
        scene: it acts only in this scene of a batch; None for all.

    Tensors may require grad: the gradient of the node velocities goes to position, velocity, rotation,
    angular_velocity and friction, through the normal and the surface velocity. Which nodes are inside is not
    differentiable, so radius and size have no gradient and refuse tensors that require one. An obstacle is a module:
    its tensors are buffers, or parameters where they are given as `nn.Parameter`. Nothing here synchronises with the
    device. The planes, spheres, boxes and capsules of a `Step` act in one kernel, `torch_mpm.ops.contact`, unless they
    have hooks, one of their tensors requires grad, or the position is a function.

    Raises:
        TypeError, ValueError: for a wrong argument; shapes of tensors are checked at the first use.
    """

    shape: str
    """Name of the shape, as in a scene file."""

    def __init__(
        self,
        position: Value | Motion,
        kind: str = "separate",
        friction: float | Tensor = 0.0,
        velocity: Value | None = None,
        rotation: Value | None = None,
        angular_velocity: Value | None = None,
        start: float = 0.0,
        end: float = math.inf,
        scene: int | None = None,
    ) -> None:
        super().__init__()
        if kind not in CONTACTS:
            raise ValueError(f"kind must be one of {sorted(CONTACTS)}, got {kind!r}")
        if not isinstance(friction, Tensor):
            friction = float(check_number("friction", friction, "a finite number >= 0", lambda v: 0 <= v < math.inf))
        for name, value in (("start", start), ("end", end)):
            check_number(name, value, "a number", lambda v: v == v)
        if not (math.isfinite(start) and start <= end):
            raise ValueError(f"start must be finite and not after end, got start {start} and end {end}")
        if scene is not None:
            check_count("scene", scene)
        if position is None:
            raise TypeError("position must be numbers, a tensor or a function of time, got None")
        if callable(position) and velocity is not None:
            raise ValueError("velocity must be None where position is a function of time: it is its derivative")
        self.position = position if callable(position) else _finite("position", position)
        self.velocity = _finite("velocity", velocity)
        self.rotation = _finite("rotation", rotation)
        self.angular_velocity = _finite("angular_velocity", angular_velocity)
        self.kind, self.friction = kind, friction
        self.start, self.end = float(start), float(end)
        self.scene = scene
        self._constants: dict[tuple[str, torch.device, torch.dtype], GraphCache] = {}
        self.kept_table = GraphCache()
        """Kept by `torch_mpm.ops.contact` for a list of obstacles that begins with this one."""

    # -- what a shape defines

    def surface(self, body: Tensor, scene: Tensor | None) -> tuple[Tensor, Tensor]:
        """Signed distance [N] [m], negative inside, and unit normal out of the body [N, D] of body coordinates [N, D].

        For contact both need to be right inside only, for `signed_distance` near the surface on both sides. A zero
        normal (as at the centre of a sphere) leaves the node alone.
        """
        raise NotImplementedError

    def extents(self) -> dict[str, Any]:
        """The parameters of the shape, in metres, as given."""
        raise NotImplementedError

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
        if velocity.shape[0] == 0 or self._absent(scene, time):
            return velocity
        centre, turn = self._centre(time, velocity), self._rotation(time, velocity, velocity.shape[1])
        if centre.shape[-1] != velocity.shape[1]:
            raise ValueError(f"position must have {velocity.shape[1]} numbers per point, got {shape_of(centre)}")
        arm = positions - _per_node(centre, 1, scene)
        turn = None if turn is None else _per_node(turn, 2, scene)
        distance, normal = self.surface(arm if turn is None else _transform(turn.mT, arm), scene)
        if turn is not None:
            normal = _transform(turn, normal)
        touching = self._touching(distance, positions, scene, time)[:, None]
        surface_velocity = self._surface_velocity(arm, scene, time)
        friction = self.friction
        if isinstance(friction, Tensor):
            friction = _per_node(self.parameter("friction", velocity, ()), 0, scene)[..., None]
        # Zero velocity stays zero; a NaN outside does not reach the gradient of the parameters.
        relative = torch.where(touching, velocity if surface_velocity is None else velocity - surface_velocity, 0)
        return velocity + contact_change(relative, normal, self.kind, friction)

    def contains(self, positions: Tensor, scene: Tensor | None, time: float | Tensor) -> Tensor:
        """Which positions are inside, bool [N]; arguments as `forward`."""
        return self._inside(self.signed_distance(positions, scene, time), positions)

    def signed_distance(self, positions: Tensor, scene: Tensor | None, time: float | Tensor) -> Tensor:
        """Distance of positions from the surface [N] [m], negative inside; infinite while the obstacle is not there.

        Arguments as `forward`. Differentiable; true near the surface, and away from it where the shape allows.
        """
        if positions.shape[0] == 0 or self._absent(scene, time):
            return positions.new_full(positions.shape[:1], torch.inf)
        pose = self.pose(time, positions)
        body = positions - _per_node(pose.centre, 1, scene)
        distance, _ = self.surface(_transform(_per_node(pose.rotation, 2, scene).mT, body), scene)
        present = self._present(scene, time)
        return distance if present is None else torch.where(present, distance, torch.inf)

    @property
    def moves(self) -> bool:
        """Whether its surface ever has a velocity."""
        return self._follows_path or self.velocity is not None or self.angular_velocity is not None

    @property
    def _follows_path(self) -> bool:
        return not isinstance(self.position, Tensor) and callable(self.position)

    def speed(self, positions: Tensor, scene: Tensor | None, time: float | Tensor, reach: float) -> Tensor:
        """Speed of the body's matter at positions no further than `reach` [m] outside, else zero [N] [m/s].

        Other arguments as `apply`.
        """
        velocity = None
        if positions.shape[0] and not self._absent(scene, time):
            arm = positions - _per_node(self._centre(time, positions), 1, scene)
            velocity = self._surface_velocity(arm, scene, time)
        if velocity is None:
            return positions.new_zeros(positions.shape[:1])
        near = self.signed_distance(positions, scene, time) <= reach
        return torch.where(near, velocity.norm(dim=-1), 0)

    def pose(self, time: float | Tensor, like: Tensor | None = None) -> Pose:
        """Centre and rotation at a time [s], a number or a tensor [] or [B]; with the dtype and device of `like`."""
        like = torch.empty(0, dtype=torch.float64, device="cpu") if like is None else like
        centre = self._centre(time, like)
        dim = centre.shape[-1]
        rotation = self._rotation(time, like, dim)
        return Pose(centre, torch.eye(dim, dtype=like.dtype, device=like.device) if rotation is None else rotation)

    # -- parameters as tensors

    def parameter(self, name: str, like: Tensor, shape: tuple[int, ...]) -> Tensor:
        """A parameter as a tensor of `shape` or [B, *shape], with the dtype and device of `like`."""
        value = getattr(self, name)
        if not isinstance(value, Tensor):
            value = self._constant(name, value, like)
        per_scene = value.dim() == len(shape) + 1 and value.shape[0] > 0
        if not (per_scene or value.dim() == len(shape)) or tuple(value.shape)[value.dim() - len(shape) :] != shape:
            alternatives = f"{list(shape)} or {['B', *shape]}".replace("'", "")
            raise ValueError(f"{name} must have shape {alternatives}, got {shape_of(value)}")
        if value.device != like.device:
            raise ValueError(f"{name} must be on the device of the nodes, {like.device}, got {value.device}")
        return value.to(like.dtype)

    def _constant(self, name: str, value: Any, like: Tensor) -> Tensor:
        """Numbers as a tensor; copied to a device once, so that later steps do not wait and can be captured."""
        if torch.compiler.is_compiling() or type(like) not in (Tensor, torch.nn.Parameter):
            return torch.tensor(value, dtype=like.dtype, device=like.device)
        kept = self._constants.setdefault((name, like.device, like.dtype), GraphCache())
        return kept.get((value,), lambda: torch.tensor(value, dtype=like.dtype, device=like.device), like)

    # -- motion

    def _absent(self, scene: Tensor | None, time: float | Tensor) -> bool:
        if scene is None and self.scene not in (None, 0):
            return True
        return not isinstance(time, Tensor) and not self.start <= time < self.end

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

    def _present(self, scene: Tensor | None, time: float | Tensor) -> Tensor | None:
        """The nodes for which the obstacle is there, bool [N] or []; None for all."""
        present = None
        if self.scene is not None and scene is not None:
            present = scene == self.scene
        if isinstance(time, Tensor):
            now = _per_node((time >= self.start) & (time < self.end), 0, scene)
            present = now if present is None else present & now
        return present

    def _elapsed(self, time: float | Tensor, like: Tensor) -> float | Tensor:
        """Time since `start`, [] or [B]."""
        return (time - self.start).to(like.dtype) if isinstance(time, Tensor) else time - self.start

    def _centre(self, time: float | Tensor, like: Tensor) -> Tensor:
        """[D] or [B, D]."""
        if self._follows_path:
            return self._path(time, like)[0]
        position = self.parameter("position", like, (_length(self.position),))
        if self.velocity is None:
            return position
        return position + self.parameter("velocity", like, position.shape[-1:]) * _column(self._elapsed(time, like), 1)

    def _path(self, time: float | Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
        """Centre and its velocity where the position is a function of time."""
        assert callable(self.position)
        if not isinstance(time, Tensor):
            time = torch.full((), time, dtype=like.dtype, device=like.device)
        centre, velocity, *_ = torch.func.jvp(self.position, (time,), (torch.ones_like(time),))
        return centre.to(like.dtype), velocity.to(like.dtype)

    def _rotation(self, time: float | Tensor, like: Tensor, dim: int) -> Tensor | None:
        """[D, D] or [B, D, D]; None where the body never turns."""
        shape = () if dim == 2 else (3,)
        rotation = None
        if self.rotation is not None:
            rotation = rotation_matrix(self.parameter("rotation", like, shape), dim)
        if self.angular_velocity is not None:
            rate = self.parameter("angular_velocity", like, shape)
            turn = rotation_matrix(rate * _column(self._elapsed(time, like), len(shape)), dim)
            rotation = turn if rotation is None else turn @ rotation
        return rotation

    def _surface_velocity(self, arm: Tensor, scene: Tensor | None, time: float | Tensor) -> Tensor | None:
        """Velocity of the body's matter at the nodes, `arm` [N, D] away from the centre; None at rest."""
        result = None
        if self._follows_path:
            result = _per_node(self._path(time, arm)[1], 1, scene)
        elif self.velocity is not None:
            result = _per_node(self.parameter("velocity", arm, arm.shape[1:]), 1, scene)
        if self.angular_velocity is None:
            return result
        if arm.shape[1] == 2:
            rate = _per_node(self.parameter("angular_velocity", arm, ()), 0, scene)[..., None]
            swirl = rate * torch.stack([-arm[:, 1], arm[:, 0]], 1)
        else:
            rate = _per_node(self.parameter("angular_velocity", arm, (3,)), 1, scene)
            swirl = torch.linalg.cross(rate.expand_as(arm), arm)
        return swirl if result is None else result + swirl


class Plane(Obstacle):
    """A half-space: everything behind a plane through `position`.

    Args:
        normal: direction out of the half-space, into the material: D numbers, or a tensor [D] or [B, D] that may
            require grad; of any length but zero.
        position, kind, friction, velocity, rotation, angular_velocity, start, end, scene: see `Obstacle`.
    """

    shape = "plane"

    def __init__(self, position: Value | Motion, normal: Value, kind: str = "separate", **motion: Any) -> None:
        super().__init__(position, kind, **motion)
        self.normal = _direction("normal", normal)

    def surface(self, body: Tensor, scene: Tensor | None) -> tuple[Tensor, Tensor]:
        normal = _unit(_per_node(self.parameter("normal", body, body.shape[1:]), 1, scene))
        return (body * normal).sum(1), normal.expand_as(body)

    def extents(self) -> dict[str, Any]:
        return {"normal": self.normal}


class Sphere(Obstacle):
    """A ball; a disc in 2-D.

    Args:
        radius: [m], a number, or a tensor [] or [B].
        position, kind, friction, velocity, rotation, angular_velocity, start, end, scene: see `Obstacle`.
    """

    shape = "sphere"

    def __init__(self, position: Value | Motion, radius: float | Tensor, kind: str = "separate", **motion: Any) -> None:
        super().__init__(position, kind, **motion)
        self.radius = _extent("radius", radius)

    def surface(self, body: Tensor, scene: Tensor | None) -> tuple[Tensor, Tensor]:
        return _norm(body) - _per_node(self.parameter("radius", body, ()), 0, scene), _unit(body)

    def extents(self) -> dict[str, Any]:
        return {"radius": self.radius}


class Box(Obstacle):
    """A box with edges along its own axes.

    Args:
        size: edge lengths [m]: D numbers, or a tensor [D] or [B, D].
        position, kind, friction, velocity, rotation, angular_velocity, start, end, scene: see `Obstacle`.
    """

    shape = "box"

    def __init__(self, position: Value | Motion, size: Value, kind: str = "separate", **motion: Any) -> None:
        super().__init__(position, kind, **motion)
        self.size = _extent("size", size)

    def surface(self, body: Tensor, scene: Tensor | None) -> tuple[Tensor, Tensor]:
        # Inside, the nearest face is that of the axis with the largest (least negative) distance.
        depth = body.abs() - 0.5 * _per_node(self.parameter("size", body, body.shape[1:]), 1, scene)
        nearest = torch.arange(body.shape[1], device=body.device) == depth.argmax(1, keepdim=True)
        return depth.amax(1), nearest * torch.where(body < 0, -1, 1).to(body.dtype)

    def extents(self) -> dict[str, Any]:
        return {"size": self.size}


class Capsule(Obstacle):
    """All points within `radius` of a segment.

    Args:
        half_axis: from the centre to one end of the segment [m]: D numbers, or a tensor [D] or [B, D] that may require
            grad. The other end is opposite.
        radius: [m], a number, or a tensor [] or [B].
        position, kind, friction, velocity, rotation, angular_velocity, start, end, scene: see `Obstacle`.
    """

    shape = "capsule"

    def __init__(
        self,
        position: Value | Motion,
        half_axis: Value,
        radius: float | Tensor,
        kind: str = "separate",
        **motion: Any,
    ) -> None:
        super().__init__(position, kind, **motion)
        self.half_axis = _finite("half_axis", _constant("half_axis", half_axis))
        self.radius = _extent("radius", radius)

    def surface(self, body: Tensor, scene: Tensor | None) -> tuple[Tensor, Tensor]:
        axis = _per_node(self.parameter("half_axis", body, body.shape[1:]), 1, scene)
        squared = (axis * axis).sum(-1, keepdim=True)
        along = (body * axis).sum(1, keepdim=True) / torch.where(squared > 0, squared, 1)
        offset = body - along.clamp(-1, 1) * axis
        return _norm(offset) - _per_node(self.parameter("radius", body, ()), 0, scene), _unit(offset)

    def extents(self) -> dict[str, Any]:
        return {"half_axis": self.half_axis, "radius": self.radius}


class Revolved(Obstacle):
    """A polygon turned about an axis: a cone, a tube, a funnel, an hourglass, a drum.

    In 2-D, the polygon and its mirror image. A wall should be at least 4 cells thick, and reach 3 cells beyond the
    domain where it meets one of its faces: nodes outside carry momentum too.

    Args:
        outline: corners of the polygon, K pairs of distance from the axis (≥ 0) and position along it [m], counted from
            `position`; not crossing itself.
        axis: direction of the axis: D numbers, or a tensor [D] or [B, D] that may require grad; y by default.
        position, kind, friction, velocity, rotation, angular_velocity, start, end, scene: see `Obstacle`.
    """

    shape = "revolved"

    def __init__(
        self,
        position: Value | Motion,
        outline: Sequence[Sequence[float]],
        axis: Value | None = None,
        kind: str = "separate",
        **motion: Any,
    ) -> None:
        super().__init__(position, kind, **motion)
        if not isinstance(outline, Sequence):
            raise TypeError(f"outline must be at least 3 pairs, got {shape_of(outline)}")
        corners = tuple(_floats("outline", corner) for corner in outline)
        if len(corners) < 3 or any(len(c) != 2 or c[0] < 0 or not all(map(math.isfinite, c)) for c in corners):
            raise ValueError(
                f"outline must be at least 3 pairs (distance >= 0, position along the axis), got {outline}"
            )
        area = sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(corners, corners[1:] + corners[:1], strict=True))
        if area == 0:
            raise ValueError(f"outline must enclose an area, got {outline}")
        self.outline = corners if area > 0 else corners[::-1]  # anticlockwise
        self.axis = None if axis is None else _direction("axis", axis)

    def surface(self, body: Tensor, scene: Tensor | None) -> tuple[Tensor, Tensor]:
        if self.axis is None:
            axis = torch.eye(body.shape[1], dtype=body.dtype, device=body.device)[1]
        else:
            axis = _unit(_per_node(self.parameter("axis", body, body.shape[1:]), 1, scene))
        along = (body * axis).sum(1, keepdim=True)
        across = body - along * axis
        distance, normal = self._polygon(torch.cat([_norm(across)[:, None], along], 1))
        return distance, normal[:, :1] * _unit(across) + normal[:, 1:] * axis

    def _polygon(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance [N] of points [N, 2] from the polygon, and outward normal [N, 2] of the nearest edge."""
        a = self.parameter("outline", p, (len(self.outline), 2))
        edge = a.roll(-1, 0) - a
        arm = p[:, None] - a
        along = (arm * edge).sum(2) / (edge * edge).sum(1)
        offset = _norm(arm - along.clamp(0, 1)[..., None] * edge)
        # An edge on the axis is inside the body.
        on_axis = (a[:, 0] == 0) & (edge[:, 0] == 0)
        nearest = torch.where(on_axis, torch.inf, offset).argmin(1, keepdim=True)
        # An odd number of edges is crossed by the ray from the point away from the axis.
        straddles = (a[:, 1] > p[:, 1:]) != (a.roll(-1, 0)[:, 1] > p[:, 1:])
        crossing = straddles & ((edge[:, 0] * arm[..., 1] - edge[:, 1] * arm[..., 0]) * edge[:, 1].sign() > 0)
        inside = crossing.sum(1) % 2 == 1
        distance = offset.gather(1, nearest)[:, 0]
        normal = _unit(torch.stack([edge[:, 1], -edge[:, 0]], 1))[nearest[:, 0]]
        return torch.where(inside, -distance, distance), normal

    def extents(self) -> dict[str, Any]:
        return {"outline": self.outline, "axis": self.axis}


class SDF(Obstacle):
    """Any shape, from its signed distance.

    Args:
        distance: function of body coordinates [N, D] [m], x − position turned back, that returns distances [N] [m],
            negative inside. Torch operations; it need not be exact away from its zero level.
        normal: function of the same coordinates that returns outward normals [N, D]; None for the gradient of
            `distance` by automatic differentiation. Of any length; where it is zero, nodes are left alone.
        position, kind, friction, velocity, rotation, angular_velocity, start, end, scene: see `Obstacle`.
    """

    shape = "sdf"

    def __init__(
        self,
        distance: Callable[[Tensor], Tensor],
        position: Value | Motion,
        kind: str = "separate",
        normal: Callable[[Tensor], Tensor] | None = None,
        **motion: Any,
    ) -> None:
        super().__init__(position, kind, **motion)
        for name, function in (("distance", distance), ("normal", normal)):
            if not callable(function) and (name == "distance" or function is not None):
                raise TypeError(f"{name} must be a function of positions [N, D], got {shape_of(function)}")
        self.distance, self.normal = distance, normal

    def surface(self, body: Tensor, scene: Tensor | None) -> tuple[Tensor, Tensor]:
        if self.normal is not None:
            distance, normal = self.distance(body), self.normal(body)
        else:
            distance, normal = _with_gradient(self.distance, body)
        if distance.shape != body.shape[:1] or normal.shape != body.shape:
            raise ValueError(
                f"distance and normal of an SDF must have shape [N] and [N, D] = {list(body.shape)}, "
                f"got {shape_of(distance)} and {shape_of(normal)}"
            )
        return distance, _unit(normal)

    def extents(self) -> dict[str, Any]:
        return {"distance": self.distance}


# ---- small tensor functions


def rotation_matrix(angle: Tensor, dim: int) -> Tensor:
    """Rotation by an angle [...] (2-D) or a rotation vector [..., 3] (3-D) [rad], as matrices [..., D, D].

    3-D by the formula of Rodrigues; smooth at the zero vector.
    """
    if dim == 2:
        c, s = angle.cos(), angle.sin()
        return torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)
    theta = _norm(angle)[..., None, None]
    x, y, z = angle.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    cross = torch.stack(rows, -2)
    first, second = torch.sinc(theta / math.pi), 0.5 * torch.sinc(theta / (2 * math.pi)) ** 2
    return torch.eye(3, dtype=angle.dtype, device=angle.device) + first * cross + second * (cross @ cross)


def _with_gradient(function: Callable[[Tensor], Tensor], points: Tensor) -> tuple[Tensor, Tensor]:
    """Values [N] of a function of points [N, D], each of its own point, and their gradients; differentiable."""
    if torch.compiler.is_compiling() or torch._C._autograd._top_saved_tensors_default_hooks(False) is None:
        values, pull_back, *_ = torch.func.vjp(function, points)
        return values, pull_back(torch.ones_like(values))[0]
    # torch.func refuses the hooks of checkpointing, which would compute its steps again for a gradient taken in them.
    differentiable = torch.is_grad_enabled()
    with torch.enable_grad(), saved_tensors_hooks(_same, _same):
        leaf = points.view_as(points)
        leaf = leaf if leaf.requires_grad else leaf.requires_grad_()
        values = function(leaf)
        (gradient,) = torch.autograd.grad(values, leaf, torch.ones_like(values), create_graph=differentiable)
    return values, gradient


def _same(t: Tensor) -> Tensor:
    return t


def _norm(v: Tensor) -> Tensor:
    """Length of vectors [..., D], with gradient zero at the zero vector."""
    squared = (v * v).sum(-1)
    return torch.where(squared > 0, torch.where(squared > 0, squared, 1).sqrt(), 0)


def _unit(v: Tensor) -> Tensor:
    """Directions of vectors [..., D]; zero for the zero vector."""
    norm = _norm(v)[..., None]
    return torch.where(norm > 0, v / torch.where(norm > 0, norm, 1), 0)


def _transform(matrix: Tensor, v: Tensor) -> Tensor:
    """Matrix [D, D] or [N, D, D] times vectors [N, D]."""
    return v @ matrix.mT if matrix.dim() == 2 else (matrix @ v[..., None])[..., 0]


def _per_node(value: Tensor, rank: int, scene: Tensor | None) -> Tensor:
    """A value of `rank` dimensions as it is, or one per scene as one per node."""
    if value.dim() == rank:
        return value
    if scene is None or value.shape[0] == 1:
        return value[0]
    return value.index_select(0, scene.clamp_min(0))


def _column(time: float | Tensor, rank: int) -> float | Tensor:
    """Times [] or [B] as factors of values [...] or [B, ...] of `rank` dimensions."""
    return time.reshape(time.shape + (1,) * rank) if isinstance(time, Tensor) and time.dim() else time


def _floats(name: str, value: Any) -> tuple[float, ...]:
    values = value if hasattr(value, "__len__") and not isinstance(value, (str, type)) else (value,)
    return tuple(float(check_number(name, a, "a number", lambda v: True)) for a in values)


def _length(value: Any) -> int:
    return int(value.shape[-1]) if isinstance(value, Tensor) and value.dim() else len(_floats("position", value))


def _finite(name: str, value: Any) -> Any:
    """Numbers checked and made immutable; None and tensors as they are."""
    if value is None or isinstance(value, Tensor):
        return value
    numbers = _floats(name, value)
    if not all(math.isfinite(a) for a in numbers):
        raise ValueError(f"{name} must be finite, got {value}")
    return numbers if hasattr(value, "__len__") else numbers[0]


def _constant(name: str, value: Any) -> Any:
    if value is None or callable(value):
        raise TypeError(f"{name} must be numbers or a tensor, got {shape_of(value)}")
    return value


def _direction(name: str, value: Any) -> Any:
    if not isinstance(_constant(name, value), Tensor) and not any(_floats(name, value)):
        raise ValueError(f"{name} must not be zero, got {value}")
    return _finite(name, value)


def _extent(name: str, value: Any) -> Any:
    if isinstance(value, Tensor):
        if value.requires_grad:
            raise ValueError(f"{name} must not require grad: which nodes are inside is not differentiable")
        return value
    value = _finite(name, _constant(name, value))
    if min(_floats(name, value), default=-1) < 0:
        raise ValueError(f"{name} must be >= 0, got {value}")
    return value
