"""Obstacles of a batch that are alike are one; each scene moves as it does alone."""

import pytest
import torch

pytest.importorskip("pydantic")

from helpers import TOLERANCE, relative_error

from torch_mpm import rollout
from torch_mpm.scene import Scene, SceneError

BASE = {
    "grid": {"lower": (0, 0), "upper": (1, 1), "dx": 0.05},
    "gravity": (0, -10),
    "duration": 0.1,
    "material": {"jelly": {"law": "neo_hookean", "E": 1e4, "nu": 0.3}},
}
BODY = {"shape": "sphere", "center": (0.5, 0.5), "radius": 0.15, "material": "jelly", "velocity": (0.5, -2.0)}


def box(x, **more):
    return {"shape": "box", "center": (x, 0.2), "size": (0.3, 0.1), **more}


WEDGE = {"shape": "revolved", "outline": ((0.0, 0.0), (0.3, 0.0), (0.0, 0.2)), "center": (0.5, 0.1)}
RING = {"shape": "torus", "center": (0.5, 0.1), "radius": 0.05}
SCENES = [
    [box(0.5), box(0.2, rotation=0.4, friction=0.3), {"shape": "sphere", "center": (0.9, 0.3), "radius": 0.1}],
    [box(0.4, velocity=(0.3, 0.0), spin=1.0)],
    [{"shape": "plane", "center": (0.5, 0.2), "normal": (0.2, 1.0)}, box(0.6, rotation=-0.2)],
    [],
    [{"shape": "capsule", "a": (0.3, 0.2), "b": (0.7, 0.25), "radius": 0.05, "contact": "sticky"}],
    [{"shape": "plane", "center": (0.5, 0.1), "normal": (0.0, 2.0)}, box(0.3, velocity=(0.1, 0.1), spin=-2.0)],
    [WEDGE],
    [{**WEDGE, "axis": (1.0, 2.0)}],
    [{**RING, "axis": (1.0, 0.2), "ring_radius": 0.1}],
    [{**RING, "axis": (2.0, -3.0), "ring_radius": 0.2}],
]


def rolled(built, dtype):
    with torch.no_grad():
        return rollout(built.step, built.state, 60, 1e-3)


def test_a_scene_of_a_batch_moves_as_alone(device):
    precise = {**BASE, "precision": "float64"}
    batch = Scene(**precise, scene=[{"body": [BODY], "obstacle": o} for o in SCENES]).build(device)
    assert len(batch.step.boundaries) == 10  # of 14: boxes at rest, boxes that move, planes and rings have met
    assert batch.step.explain(batch.state).startswith("all steps")
    end = rolled(batch, torch.float64)
    for k, obstacles in enumerate(SCENES):
        alone = rolled(Scene(**precise, body=[BODY], obstacle=obstacles).build(device), torch.float64)
        error = relative_error(end.x[end.scene == k], alone.x)
        assert error <= TOLERANCE["rollout"][torch.float64], (k, error)
    free = rolled(Scene(**precise, body=[BODY]).build(device), torch.float64)
    moved = [relative_error(end.x[end.scene == k], free.x) for k in range(len(SCENES))]
    assert moved[3] <= TOLERANCE["rollout"][torch.float64] and min(moved[:2]) > 1e-3  # the obstacles are felt


def test_held_temperatures_of_a_batch():
    hot = {"conductivity": 50.0, "specific_heat": 10.0}
    words = {**BASE, "material": {"jelly": {**BASE["material"]["jelly"], **hot}}, "heat": {"reference": 300.0}}
    plates = [[box(0.5, temperature=t, held="surface")] for t in (300.0, 400.0)] + [[]]
    body = {**BODY, "center": (0.5, 0.41), "velocity": (0.0, 0.0), "temperature": 300.0}
    built = Scene(**words, scene=[{"body": [body], "obstacle": o} for o in plates]).build("cpu")
    assert len(built.step.boundaries) == 1
    with torch.no_grad():
        end = rollout(built.step, built.state, 40, 1e-3)
    means = [float(end.temperature[end.scene == k].mean()) for k in range(3)]
    assert abs(means[0]) < 1e-3 and means[1] > 1.0 and abs(means[2]) < 1e-3


def test_particles_seeded_inside_obstacles_are_refused_or_moved_and_counted():
    """A block that reaches dx/2 into a floor in the second of three scenes."""
    block = {"shape": "box", "lower": (0.3, 0.225), "upper": (0.7, 0.4), "material": "jelly"}
    floor = {"shape": "box", "center": (0.5, 0.0), "size": (2.0, 0.5)}
    scenes = [{"body": [block]}, {"body": [block], "obstacle": [floor]}]
    scenes.append({"body": [{**block, "lower": (0.3, 0.25)}], "obstacle": [floor]})
    with pytest.raises(SceneError, match=r"are inside scene.1.*or set project = true"):
        Scene(**BASE, scene=scenes).build("cpu")
    free = Scene(**BASE, scene=[{"body": scene["body"]} for scene in scenes]).build("cpu").state
    inside = (free.x[:, 1] < 0.25) & (free.scene == 1)
    moved = Scene(**BASE, scene=scenes, project=True).build("cpu")
    assert moved.projected.tolist() == [0, int(inside.sum()), 0] and bool(inside.any())
    expected = free.x.clone()
    expected[inside, 1] = 0.25
    torch.testing.assert_close(moved.state.x, expected)
