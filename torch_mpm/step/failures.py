"""Failures of scenes: counted on the device without waiting for it, and described in words."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..errors import GridOverflowError, SimulationError
from ..grid.topology import SceneStatus, Status
from ..state.state import PARTICLE_FIELDS, State

if TYPE_CHECKING:
    from ..grid.grid import Grid
    from ..laws.material import Material

NAMED = 12
"""Number of scenes that a message names for each kind of problem."""
LOST = "not_finite"
CONSEQUENCES = ("velocity", "deformation")
"""Kinds that a message omits where a scene has another problem, since they mostly are consequences of it."""
CHECK_DT = "the time step was probably too large; compare dt with step.stable_dt(state)"


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """One kind of problem in each of B scenes; tensors [B] on the device of the particles.

    Attributes:
        count: number: of particles when first found; of steps so far for "dt", of solves so far for "heat". 0 for none.
        what, advice: description of the problem and of the remedy.
        first: lowest index of these particles, -1 for none; None for problems that do not concern particles.
        id: id of that particle, or its index where the state had no ids.
        step: step in which it was first found, counted from 0, -1 for none; None where unknown.
        size: size of the worst one.
        size_in_words: format of the size.
    """

    count: Tensor
    what: str
    advice: str
    first: Tensor | None = None
    id: Tensor | None = None
    step: Tensor | None = None
    size: Tensor | None = None
    size_in_words: str = ""

    def sentence(self, others: Sequence[bool]) -> str:
        """Sentence about the affected scenes, except `others`; "" for none. Synchronises."""
        counts = self.count.tolist()
        scenes = [b for b, count in enumerate(counts) if count and not others[b]]
        if not scenes:
            return ""
        first, identity, step, size = (
            None if t is None else t.tolist() for t in (self.first, self.id, self.step, self.size)
        )
        parts = []
        for b in scenes[:NAMED]:
            details = [] if step is None else [f"first at step {step[b]}"]
            if first is not None and identity is not None:
                details.append(f"lowest index {first[b]}" + (f", id {identity[b]}" if identity[b] != first[b] else ""))
            if size is not None:
                details.append(self.size_in_words.format(size[b]))
            parts.append(f"{counts[b]} in scene {b}" + (f" ({', '.join(details)})" if details else ""))
        if len(scenes) > NAMED:
            parts.append(f"and more in {len(scenes) - NAMED} other scenes")
        return f"{sum(counts[b] for b in scenes)} {self.what}: {'; '.join(parts)}: {self.advice}"


@dataclasses.dataclass(frozen=True, eq=False)
class Failures:
    """Failed scenes and their problems.

    Attributes:
        failed: whether a scene has any problem, bool [B] on the device of the particles.
        given: NaN or infinite entries of the first state of the step, by field; in the error of `Step.check` also of
            the state given to the latest call, of gravity and of the motion of obstacles. Not problems themselves, but
            the cause of later ones.
        problems: each kind that was checked:
            "not_finite": particles whose position is NaN or infinite,
            "outside": particles that left the grid,
            "dt": steps whose entry of a tensor dt was negative or NaN,
            "pose": obstacles with an assigned pose that differs from the result of their velocity,
            "heat_data", "heat": solves of heat without a result, or that missed their tolerance,
            and in the given state "mass", "volume", "velocity" and "deformation".
    """

    failed: Tensor
    problems: dict[str, Problem]
    given: dict[str, Problem] = dataclasses.field(default_factory=dict)

    @staticmethod
    def of(problems: dict[str, Problem], scenes: int, given: dict[str, Problem] | None = None) -> Failures:
        """Failures of B scenes, on the device of the problems."""
        device = next((problem.count.device for problem in problems.values()), "cpu")
        failed = torch.zeros(scenes, dtype=torch.bool, device=device)
        for problem in problems.values():
            failed = failed | (problem.count > 0)
        return Failures(failed, problems, given or {})

    def sentences(self) -> list[str]:
        """A sentence for each kind of problem found; synchronises."""
        sentences, explained = self._of_given()
        others = list(explained)
        for kind, problem in sorted(self.problems.items(), key=lambda item: item[0] in CONSEQUENCES):
            without = others if kind in CONSEQUENCES else explained if kind == LOST else [False] * len(others)
            sentence = problem.sentence(without)
            if sentence:
                sentences.append(sentence)
                others = [a or count > 0 for a, count in zip(others, problem.count.tolist(), strict=True)]
        return sentences

    def _of_given(self) -> tuple[list[str], list[bool]]:
        """Sentences about the first state, in scenes with failures like those of a large time step; and the kinds it
        explains.
        """
        fine = [True] * len(self.failed)
        for kind in (LOST, *CONSEQUENCES):
            if kind in self.problems:
                fine = [a and count == 0 for a, count in zip(fine, self.problems[kind].count.tolist(), strict=True)]
        sentences, explained = list[str](), [False] * len(fine)
        for problem in self.given.values():
            if sentence := problem.sentence(fine):
                sentences.append(sentence)
                counts = problem.count.tolist()
                explained = [a or (count > 0 and not b) for a, count, b in zip(explained, counts, fine, strict=True)]
        return sentences, explained


def problems_of_status(statuses: Iterable[Tensor], grid: Grid) -> dict[str, Problem]:
    """Problems of scenes in status tensors [1 + B, 8] of `activate`; the first one of each scene counts."""
    rows: Tensor | None = None
    for status in statuses:
        known = status[1:] if rows is None else rows
        rows = torch.where(known[:, Status.PROBLEM_ACTIVATION, None] >= 0, known, status[1:])
    if rows is None:
        return {}
    column = rows.unbind(1)
    step = column[Status.PROBLEM_ACTIVATION]
    domain = f"particles left the grid [{grid.lower}, {grid.upper}]"
    return {
        LOST: Problem(
            column[Status.NON_FINITE_COUNT],
            "particles have a position that is NaN or infinite",
            CHECK_DT,
            column[Status.NON_FINITE_FIRST],
            column[SceneStatus.NON_FINITE_ID],
            step,
        ),
        "outside": Problem(
            column[Status.OUTSIDE_COUNT],
            domain,
            "enlarge the domain, add walls, or reduce dt",
            column[Status.OUTSIDE_FIRST],
            column[SceneStatus.OUTSIDE_ID],
            step,
        ),
    }


def problem_of_particles(state: State, scenes: int, bad: Tensor, what: str, advice: str) -> Problem:
    """Problem of the particles of a mask, bool [P], in each scene."""
    index = torch.arange(len(state), device=bad.device)
    scene = torch.zeros_like(index) if state.scene is None else state.scene.long()
    bad = bad & (scene >= 0) & (scene < scenes)
    scene = torch.where(bad, scene, scenes)  # Other entries go to an extra scene, which is cut off.
    count = index.new_zeros(scenes + 1).index_add_(0, scene, bad.long())[:-1]
    first = index.new_full((scenes + 1,), len(state)).scatter_reduce_(0, scene, index, "amin")[:-1]
    first = torch.where(count > 0, first, -1)
    identity = first
    if state.ids is not None and len(state):
        identity = torch.where(count > 0, state.ids[first.clamp_min(0)], -1)
    return Problem(count, f"particles {what}", advice, first, identity)


def problems_of_first_state(state: State, scenes: int, when: str = "before the first step") -> dict[str, Problem]:
    """NaN or infinite entries of the state before steps, by field. Does not wait for the device."""
    problems = {}
    fields = {name: getattr(state, name) for name in PARTICLE_FIELDS} | state.extra
    for name, value in fields.items():
        if value is None or not value.is_floating_point():
            continue
        nothing = 0 * value.detach()  # Also NaN.
        bad = ~(nothing.flatten(1).sum(1) if nothing.dim() > 1 else nothing).eq(0)
        if bad.device.type != "cpu" or bool(bad.any()):
            problems[name] = problem_of_particles(
                state,
                scenes,
                bad,
                f"had {name} that is NaN or infinite in the state {when}",
                "give each particle finite values",
            )
    return problems


def problems_of_state(law: Material, state: State, scenes: int, taken: bool = True) -> dict[str, Problem]:
    """Problems of a state that has all fields that the law needs, before or after steps."""

    def problem(bad: Tensor, what: str, advice: str) -> Problem:
        return problem_of_particles(state, scenes, bad, what, advice)

    def not_positive(value: Tensor) -> Tensor:
        return ~((value > 0) & (value < torch.inf))

    return {
        "mass": problem(
            not_positive(state.mass),
            "have a mass that is not positive and finite",
            "give each particle its mass; a tracer needs none, as g2p gathers the velocity at any position",
        ),
        "volume": problem(
            not_positive(state.volume),
            "have a rest volume that is not positive and finite",
            "give each particle its volume without deformation",
        ),
        "velocity": problem(
            ~state.v.isfinite().all(1),
            "have a velocity that is NaN or infinite",
            CHECK_DT if taken else "give each particle a finite velocity",
        ),
        "deformation": problem(
            law.invalid(state),
            "are inverted or not finite",
            "the time step was too large or the load crushed the material; compare dt with step.stable_dt(state)"
            if taken
            else "give each particle a deformation that its law has a meaning for",
        ),
    }


def refused_steps(count: Tensor) -> Problem:
    """Number of steps of each scene [B] with an invalid dt."""
    return Problem(
        count,
        "steps had a dt that was negative or NaN, so that the scene was paused",
        "give each scene a dt that is positive, or zero to pause it",
    )


def contradicted_poses(count: Tensor) -> Problem:
    """Number of obstacles of each scene [B], accumulated over calls, with a pose that differs from the result of their
    velocity.
    """
    return Problem(
        count,
        "obstacles were assigned a pose while they have a velocity, but are not where it has led them",
        "set their velocity and angular_velocity to None, or move them by Obstacle.place",
    )


def unsolved_heat(unsolved: Tensor, residual: Tensor, iterations: int) -> dict[str, Problem]:
    """Failed heat solves of each scene [B], and their largest residual [B] [K], NaN where the data are not finite."""
    without = residual.isnan()
    return {
        "heat_data": Problem(
            torch.where(without, unsolved, 0),
            "heat solves had no result",
            "a temperature, a conductivity or a boundary is not finite, or a conductivity is negative",
        ),
        "heat": Problem(
            torch.where(without, 0, unsolved),
            "heat solves missed their tolerance",
            "reduce dt, or raise max_iterations or tolerance",
            size=residual,
            size_in_words=f"a residual of {{:.3g}} K was left after {iterations} iterations",
        ),
    }


def unsolved_steps(unsolved: Tensor, residual: Tensor) -> dict[str, Problem]:
    """Implicit steps of each scene [B] that missed their tolerance, and their largest residual [B] [m/s]."""
    return {
        "implicit": Problem(
            unsolved,
            "implicit steps missed their tolerance",
            "reduce dt, or raise max_iterations, max_cg_iterations or tolerance of the integrator",
            size=residual,
            size_in_words="a residual of {:.3g} m/s was left",
        )
    }


def _full_grid(grid: Grid, peak: int, when: str, comes_first: bool) -> str:
    """Sentence about a grid with too few blocks for the largest number of active blocks, `peak`; "" otherwise.

    A pool that grows may be larger by now: then the status alone reports it, if this `comes_first` of all problems.
    """
    if grid.grows and comes_first:
        return (
            f"up to {peak} blocks were active, more than the pool of the grid had room for in some steps{when}: it "
            f"follows the scene between calls, so take fewer steps in a call, or pass max_blocks={peak + peak // 2}"
        )
    if grid.grows or grid.max_blocks is None or peak <= grid.max_blocks:
        return ""
    return (
        f"{peak} blocks were active but the grid has max_blocks={grid.max_blocks}{when}: "
        "pass a larger max_blocks, or None to let it grow"
    )


def raise_failures(failures: Failures, statuses: Iterable[Tensor], grid: Grid) -> None:
    """Raise one error for all problems of scenes, particles without a scene and a full grid; synchronises.

    Raises:
        SimulationError: with the failures as its attribute.
        GridOverflowError: where a full grid is the only problem.
    """
    sentences, full = failures.sentences(), ""
    for status in statuses:  # The later ones continue from the others.
        total, *scenes = status.tolist()
        peak, outside, _, lost, _, _, step, _ = total
        for row in scenes:
            if row[6] == step:  # Found in the same activation, so counted there too.
                outside, lost = outside - row[1], lost - row[3]
        if outside + lost > 0:
            sentences.append(
                f"{outside + lost} particles have a scene id outside the {grid.scenes} scenes of the grid, first at "
                f"step {step}: give each particle a scene from 0 to {grid.scenes - 1}"
            )
        of_particles = outside + lost > 0 or any(row[6] >= 0 for row in scenes)
        comes_first = step >= 0 and outside + lost == 0 and all(row[6] != step for row in scenes)
        when = "" if of_particles else f", first at step {step}"
        full = full or _full_grid(grid, peak, when, comes_first)
    if sentences:
        raise SimulationError("\n".join(sentences + [full] * bool(full)), failures)
    if full:
        raise GridOverflowError(full, failures)
