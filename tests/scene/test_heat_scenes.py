"""Scene files with heat: their meaning, their results, and refused contents."""

import math
import signal
from pathlib import Path

import numpy as np
import pytest
from helpers import disc

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

import torch_mpm as mpm
from torch_mpm import Trajectory
from torch_mpm.scene import Scene
from torch_mpm.scene.diagnose import SceneFailure
from torch_mpm.scene.explain import SceneError
from torch_mpm.scene.run import Interrupted

WAX = {
    "law": "neo_hookean",
    "E": {"temperature": [300, 320], "value": [2e4, 1e4]},
    "density": 1000.0,
    "conductivity": 50.0,
    "specific_heat": 100.0,
    "expansion": 1e-4,
    "melting_point": 320.0,
    "latent_heat": 500.0,
    "liquid": {"bulk_modulus": 1e4, "viscosity": 1.0},
}
HOT = {"shape": "box", "center": (0.5, 0.1), "size": (1, 0.2), "temperature": 400.0}


def wax(**changes):
    """The disc as wax above a hot plate."""
    words = {"heat": {"reference": 300.0}, "material": {"jelly": WAX}, "obstacle": [HOT], "device": "cpu"}
    words |= {
        "body__0__temperature": 310.0,
        "body__0__center": (0.5, 0.42),
        "output": {"fields": ["temperature", "liquid"]},
    }
    return disc(**{**words, **changes})


def simulate(folder, words, **options):
    summary = Scene(**words).run(folder, **options)
    with Trajectory(folder) as read:
        return summary, {name: read[name] for name in read.file}


def test_disc_melts_where_it_touches_the_plate(tmp_path):
    summary, data = simulate(tmp_path / "out", wax(duration=0.3))
    assert summary["particles_lost"] == 0
    np.testing.assert_allclose(data["temperature"][0], 310.0)
    assert data["liquid"][0].max() == 0 and data["liquid"][-1].max() == 1 and data["liquid"][-1].min() == 0
    lowest = data["position"][-1][:, 1] < 0.25
    assert data["temperature"][-1][lowest].mean() > 320 > data["temperature"][-1][~lowest].mean()
    assert data["temperature"][-1].max() < 401
    assert data["heat"][-1] > data["heat"][0]


def test_face_and_surroundings_bring_their_heat(tmp_path):
    """A body in free fall with a flux through a face that stays, and one that radiates nothing in balance."""
    face = {"lower": (0.4, 0.45), "upper": (0.6, 0.45), "flux": 1e4}
    heat = {
        "reference": 300.0,
        "face": [face],
        "exchange": [{"coefficient": 10.0, "emissivity": 0.5, "ambient": 300.0}],
    }
    _, data = simulate(tmp_path / "out", wax(heat=heat, obstacle=[], gravity=None, body__0__temperature=300.0))
    assert data["heat"][-1] - data["heat"][0] == pytest.approx(1e4 * 0.2 * 0.1, rel=0.02)


def test_two_materials_and_a_batch(tmp_path):
    """Each material has its own heat; scenes of a batch do not exchange any."""
    inert = {"law": "weakly_compressible", "bulk_modulus": 1e4, "conductivity": 0.0, "specific_heat": 1000.0}
    body = {"shape": "sphere", "center": (0.2, 0.4), "radius": 0.1, "material": "inert", "temperature": 350.0}
    words = wax(material={"jelly": WAX, "inert": inert}, duration=0.05, gravity=None, obstacle=[])
    words["body"][0]["center"] = (0.6, 0.5)
    words["scene"] = [{"name": "a", "body": [body]}, {"name": "b"}]
    _, data = simulate(tmp_path / "out", words)
    of_inert = data["material"] == 1
    assert of_inert.sum() > 0 and len(set(data["material"].tolist())) == 3
    np.testing.assert_allclose(data["temperature"][-1][of_inert], 350.0, atol=1e-2)
    np.testing.assert_allclose(data["temperature"][-1][~of_inert], 310.0, atol=1e-2)


def test_resumed_run_is_the_same(tmp_path):
    """Temperature, its gradient and the liquid fraction go through the checkpoint."""
    _, expected = simulate(tmp_path / "whole", wax())

    def interrupt(figures):
        if figures["frame"] == 2:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(Interrupted):
        Scene(**wax()).run(tmp_path / "cut", progress=interrupt)
    _, resumed = simulate(tmp_path / "cut", wax(), resume=True)
    for name in ("temperature", "liquid", "position"):
        np.testing.assert_array_equal(resumed[name], expected[name])


def test_emitted_matter_has_its_temperature(tmp_path):
    emitter = {
        "center": (0.5, 0.8), "radius": 0.1, "velocity": (0.0, -1.0), "material": "jelly", "temperature": 315.0,
    }  # fmt: skip
    _, data = simulate(tmp_path / "out", wax(emitter=[emitter], obstacle=[]))
    first, last = (int(data["particles"][k]) for k in (0, -1))
    assert last > first
    np.testing.assert_allclose(data["temperature"][-1][first:last].mean(), 315.0, atol=0.5)


def test_heated_bar_has_the_temperature_of_the_exact_solution(tmp_path):
    """One end held at 400 K: 100 [1 − Σ 2/a_k exp(−a_k² α t) sin(a_k x)] above 300 K, a_k = (k + 1/2) π, α = 0.02."""
    overrides = ["grid.dx=0.05", "duration=5.0", "fps=1", "material.rubber.expansion=0.0", 'device="cpu"']
    overrides += ['output.fields=["temperature"]']
    Scene.load(Path(__file__).parents[2] / "examples" / "heated_bar.toml", overrides).run(tmp_path / "out")
    with Trajectory(tmp_path / "out") as read:
        x, theta = read["position"][-1][:, :1] - 0.1, read["temperature"][-1]
    a = (np.arange(50) + 0.5) * math.pi
    exact = 400 - 100 * (2 / a * np.exp(-(a**2) * 0.02 * 5) * np.sin(a * x)).sum(1)
    np.testing.assert_allclose(theta, exact, atol=0.25)


@pytest.mark.parametrize("fault", ["unsolved", "lagging"])
def test_faults_of_heat_are_reported(tmp_path, fault, monkeypatch):
    """In the segment in which they occur."""
    built = Scene.build

    def with_fault(scene, device=None):
        result = built(scene, device)
        result.step.heat.conductivity = 1e7
        if fault == "unsolved":
            result.step.heat.max_iterations = 1
        return result

    monkeypatch.setattr(Scene, "build", with_fault)
    heat = {"reference": 300.0, "exchange": [{"coefficient": 1e5, "ambient": 900.0}]}
    words = wax(duration=0.02, heat=heat, body__0__temperature=319.9)
    if fault == "unsolved":
        with pytest.raises(SceneFailure, match="heat"):
            simulate(tmp_path / "out", words)
    else:
        with pytest.warns(mpm.FrontWarning):
            simulate(tmp_path / "out", words)


def test_method_of_the_solve(tmp_path):
    """Every method comes to the same temperatures, and is the one of the step."""
    results = []
    for method in ("cg", "chebyshev", "multigrid"):
        words = wax(heat={"reference": 300.0, "method": method}, duration=0.1, body__0__center=(0.5, 0.4))
        assert Scene(**words).build().step.heat.method == method
        results.append(simulate(tmp_path / method, words)[1]["temperature"][-1])
    assert results[0].max() > 315
    np.testing.assert_allclose(results[1], results[0], atol=1e-3)
    np.testing.assert_allclose(results[2], results[0], atol=1e-3)


def test_sand_warms_by_the_energy_it_loses(tmp_path):
    """Mechanical energy lost by the column of the example is heat, except the part lost to floor and transfer."""
    overrides = ["grid.dx=0.04", "duration=0.6", "fps=5", 'device="cpu"']
    Scene.load(Path(__file__).parents[2] / "examples" / "friction_heat.toml", overrides).run(tmp_path / "out")
    with Trajectory(tmp_path / "out") as read:
        mechanical = sum(read[f"{kind}_energy"] for kind in ("kinetic", "elastic", "potential"))
        heat = read["heat"]
    assert (np.diff(heat) > 0).all()
    assert 0.7 < (heat[-1] - heat[0]) / (mechanical[0] - mechanical[-1]) < 1.0


@pytest.mark.parametrize(
    "changes,message",
    [
        ({"heat": None}, "material.jelly.conductivity: needs a [heat] table"),
        ({"heat": None}, "body[0].temperature: needs a [heat] table"),
        ({"heat": None}, "material.jelly.E: needs a [heat] table"),
        ({"material__jelly": {"law": "neo_hookean", "E": 1e4}}, "material.jelly.conductivity: missing"),
        ({"material__jelly": {**WAX, "latent_heat": None}}, "melting_point and latent_heat must be given together"),
        (
            {"material__jelly": {**WAX, "latent_heat": None, "melting_point": None}},
            "material.jelly.liquid: needs melting",
        ),
        ({"material__jelly": {**WAX, "conductivity": -1.0}}, "material.jelly.conductivity"),
        ({"material__jelly": {**WAX, "E": {"temperature": [2, 1], "value": [1, 1]}}}, "increasing temperatures"),
        ({"material__jelly": {**WAX, "E": {"temperature": [1, 2], "value": [1]}}}, "as many values as temperatures"),
        ({"heat__face": [{"lower": (0, 0), "upper": (1, 1), "flux": 1}]}, "upper must equal lower along one axis"),
        ({"heat__method": "gauss"}, "heat.method: takes one of 'cg', 'chebyshev', 'multigrid', got 'gauss'"),
        ({"obstacle": [{**HOT, "temperature": None, "held": "surface"}]}, 'held: "surface" needs a temperature'),
        ({"obstacle": [{**HOT, "held": "face"}]}, "held: takes one of 'nodes', 'surface', got 'face'"),
        (
            {"obstacle": [{**HOT, "held": "surface"}], "heat__method": "chebyshev"},
            'obstacle[0].held: "surface" needs heat.method "cg" or "multigrid"',
        ),
        ({"heat__transfer": "upic"}, "heat.transfer: takes one of 'hybrid', 'apic', 'flip', 'pic', got 'upic'"),
    ],
)
def test_bad_words(changes, message):
    with pytest.raises(SceneError) as error:
        Scene(**wax(**changes)).build()
    assert message in str(error.value)
