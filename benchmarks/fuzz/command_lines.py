"""Random command lines: every subcommand and option with wrong, huge and foreign values beside right ones."""

from __future__ import annotations

import random
from pathlib import Path

VALUES = (
    *("0", "-1", "1", "-0.0", "1e-300", "1e-12", "1e-9", "1e30", "1e300", "-1e300", "1e308", "nan", "inf", "-inf"),
    *("9" * 26, "9" * 4000, "0x10", "1_000", "18446744073709551616", "9223372036854775808", "1979-05-27", "07:32:00"),
    *('""', '"x"', "x", "", "\x00", '"\\u0000"', '"a\\u0000b"', "💥", '"\udcff"', '"' + "a" * 5000 + '"', "true"),
    *('"mps"', '"meta"', '"xpu"', '"cuda:99"', '"cuda:-1"', '"cpu:7"', '"cpu"', '"hpu"', '"../x"', '"/dev/zero"'),
    *("[]", "[[]]", "{}", "[{}]", "[1, 2]", "[[1, 2], [3, 4]]", "[0.0, 0.0]", "[1e30, 1e30]", "[1e300, 0.0]"),
    *("[1e308, -1e308]", "[nan, 0.0]", "[0.0, 0.0, 0.0]", "{a = 1}", "{choice = [1, 2]}", "{choose = [1, 2]}"),
    *("{uniform = [0, 1]}", "{uniform = [-1e308, 1e308]}", "{normal = [0, 1e308]}", f"{{integers = [0, {10**30}]}}"),
    *("{log_uniform = [1e-308, 1e308]}", "{direction = 1e308}", "{in_box = [[-1e308, -1e308], [1e308, 1e308]]}"),
)  # fmt: skip
NUMBERS = (
    *("0", "-1", "1", "2", "0.5", "1e-300", "1e-40", "1e-12", "1e-6", "1e6", "1e12", "1e30", "1e300", "-1e300"),
    *("1e308", "5e-324", "18446744073709551615", "18446744073709551616", "9223372036854775808", "2147483648", "9" * 26),
)  # fmt: skip
NUMBER_KEYS = (
    *("duration", "fps", "dt", "cfl", "seed", "flip", "grid.dx", "grid.friction", "material.jelly.E"),
    *("material.jelly.density", "material.jelly.nu", "body[0].radius", "body[0].spin", "body[0].per_cell"),
    *("body[0].particles", "obstacle[0].radius", "obstacle[0].spin", "obstacle[0].start", "obstacle[0].end"),
    *("obstacle[0].friction", "obstacle[0].rotation", "emitter[0].rate", "emitter[0].radius", "emitter[0].start"),
    *("emitter[0].end", "emitter[0].per_cell", "heat.reference", "render.layers", "render.every"),
    *("body[0].temperature",),
)  # fmt: skip
VECTOR_KEYS = (
    *("gravity", "origin", "grid.lower", "grid.upper", "body[0].center", "body[0].velocity", "obstacle[0].center"),
    *("obstacle[0].velocity", "emitter[0].velocity", "emitter[0].center", "render.range", "render.resolution"),
)  # fmt: skip
DRAWN_KEYS = ("material.jelly.E", "body[0].velocity[0]", "body[0].spin", "gravity[1]", "body[0].center", "dataset.gap")
DISTRIBUTIONS = ("uniform", "log_uniform", "normal", "integers")
SCENE_KEYS = (
    *("title", "duration", "fps", "dt", "cfl", "seed", "device", "precision", "gravity", "origin", "transfer", "flip"),
    *("grid", "grid.dx", "grid.lower", "grid.upper", "grid.walls", "grid.kernel", "grid.friction"),
    *("material", "material.jelly", "material.jelly.E", "material.jelly.nu", "material.jelly.density"),
    *("material.jelly.law", "body", "body[0]", "body[0].shape", "body[0].center", "body[0].radius", "body[0].velocity"),
    *("body[0].spin", "body[0].per_cell", "body[0].particles", "body[0].seeding", "body[0].material", "body[0].name"),
    *("body[9].radius", "obstacle", "obstacle[0].center", "obstacle[0].radius", "obstacle[0].velocity"),
    *("obstacle[0].spin", "obstacle[0].start", "obstacle[0].end", "obstacle[0].friction", "obstacle[0].rotation"),
    *("emitter", "emitter[0].rate", "emitter[0].velocity", "emitter[0].radius", "emitter[0].start", "emitter[0].end"),
    *("heat", "heat.reference", "scene", "output", "output.fields", "output.vtk", "output.ply", "render"),
    *("render.color_by", "render.range", "render.resolution", "render.every", "render.view", "nope", "grid.nope", ""),
)  # fmt: skip
SET_KEYS = (
    *("dataset", "dataset.splits", "dataset.splits.train", "dataset.frames", "dataset.interval", "dataset.fields"),
    *("dataset.seed", "dataset.particles", "dataset.gap", "dataset.scenes_per_shard", "dataset.attempts"),
    *("dataset.obstacles", "dataset.particle_type", "dataset.particle_type.jelly", "dataset.nope", "body[0].count"),
    *("body[0].size", "body[0].velocity", "body[0].spin", "body[0].choice", "material.jelly.E", "gravity", "grid.dx"),
    *("obstacle[0].count", "obstacle[0].center", "obstacle[0].start", "body[0].material", "body[0].center"),
)  # fmt: skip
FORMATS = ("gns", "well", "vtk", "ply", "tfrecord", "lagrangebench", "neuralmpm")
COMMANDS = (
    *("run", "run", "check", "check", "info", "render", "export", "export", "generate", "generate", "verify", "stats"),
    *("finalize", "view", "schema", "surface", "usd"),
)  # fmt: skip


def random_line(rng: random.Random, inputs: Path, out: Path) -> list[str]:
    """Arguments of a command line.

    Args:
        inputs: folder with scene.toml, set.toml, run and set.
        out: folder that the command may make.
    """
    command, picture = rng.choice(COMMANDS), rng.choice(("x.png", "x.nope", "x", "x.svg"))
    scene, folder = str(inputs / "scene.toml"), str(inputs / rng.choice(("run", "set")))
    chosen = {
        "run": _run(_path(scene, rng, inputs), out, rng),
        "check": [_path(scene, rng, inputs), *_sets(SCENE_KEYS, rng)],
        "info": [_path(scene, rng, inputs), *_sets(SCENE_KEYS, rng)],
        "render": [_path(folder, rng, inputs), "-o", str(out), *_render(rng)],
        "export": [_path(folder, rng, inputs), "-o", str(out), "--format", _or_value(FORMATS, rng), *_export(rng)],
        "generate": _generate(rng, inputs, out),
        "verify": [_path(str(inputs / "set"), rng, inputs), *_maybe("--most-failed", rng, VALUES)],
        "stats": [_path(str(inputs / "set"), rng, inputs), "-o", str(out / picture)],
        "finalize": [_path(str(inputs / "set"), rng, inputs)],
        "view": [str(inputs / "nothing"), "--port", rng.choice(VALUES), "--host", rng.choice(VALUES)],
        "schema": [*_maybe("x", rng)],
        "surface": [_path(folder, rng, inputs), "-o", str(out), *_surface(rng), *_maybe("--format", rng, VALUES)],
        "usd": [_path(folder, rng, inputs), "-o", f"{out}.usdc", *_maybe("--grains", rng), *_surface(rng)],
    }  # fmt: skip
    return [command, *chosen[command]]


def _path(right: str, rng: random.Random, inputs: Path) -> str:
    """Mostly the right path."""
    wrong = (str(inputs), str(inputs / "nothing"), "/dev/null", "/dev/zero", "", "\x00", "x" * 300, "/proc/self/mem")
    return right if rng.random() < 0.85 else rng.choice((*wrong, *(str(path) for path in sorted(inputs.iterdir()))))


def _sets(keys: tuple[str, ...], rng: random.Random) -> list[str]:
    pairs = [_pair(keys, rng) for _ in range(rng.choice((1, 1, 1, 2)))]
    return [word for pair in pairs for word in ("--set", pair)]


def _pair(keys: tuple[str, ...], rng: random.Random) -> str:
    """A key and any value, or an extreme value of the type that it takes."""
    kind = rng.random()
    if kind < 0.3:
        return f"{rng.choice(keys)}={rng.choice(VALUES)}"
    if kind < 0.4 and keys is SET_KEYS:
        return f"{rng.choice(DRAWN_KEYS)}={{{rng.choice(DISTRIBUTIONS)} = [{_number(rng)}, {_number(rng)}]}}"
    if kind < 0.55 and keys is SET_KEYS:
        return f"{rng.choice(keys)}={_number(rng)}"
    if kind < 0.8:
        return f"{rng.choice(NUMBER_KEYS)}={_number(rng)}"
    return f"{rng.choice(VECTOR_KEYS)}=[{_number(rng)}, {_number(rng)}]"


def _number(rng: random.Random) -> str:
    return rng.choice(NUMBERS)


def _maybe(option: str, rng: random.Random, values: tuple[str, ...] = ()) -> list[str]:
    if rng.random() < 0.75:
        return []
    return [option, rng.choice(values)] if values else [option]


def _or_value(words: tuple[str, ...], rng: random.Random) -> str:
    return rng.choice(words if rng.random() < 0.9 else VALUES)


def _run(scene: str, out: Path, rng: random.Random) -> list[str]:
    return [scene, "-o", str(out), "--quiet", *_sets(SCENE_KEYS, rng), *_maybe("--resume", rng)]


def _render(rng: random.Random) -> list[str]:
    return [
        *rng.choice((["--no-video"], ["--no-video"], [])),
        *_maybe("--scenes", rng, ("0", "0,1", "99", "-1", *VALUES)),
        *_maybe("--color-by", rng, ("F", "material", "cauchy_stress", "position", *VALUES)),
        *(_sets(SCENE_KEYS, rng) if rng.random() < 0.3 else []),
    ]


def _export(rng: random.Random) -> list[str]:
    return [
        *_maybe("--dx", rng, ("0.1", "1e-9", *VALUES)),
        *_maybe("--material", rng, ("friction_angle", "mass", "position", *VALUES)),
        *_maybe("--scenes", rng, ("0", "99", *VALUES)),
        *_maybe("--fields", rng, ("F", "stress", "velocity,velocity", "mass", *VALUES)),
        *_maybe("--context", rng),
    ]


def _surface(rng: random.Random) -> list[str]:
    return [
        *_maybe("--cube-size", rng, ("0.01", *VALUES)),
        *_maybe("--smoothing-length", rng, ("0.02", *VALUES)),
        *_maybe("--iso-threshold", rng, ("0.5", *VALUES)),
        *_maybe("--smoothing", rng, ("1", *VALUES)),
        *_maybe("--material", rng, ("jelly", *VALUES)),
        *_maybe("--every", rng, ("2", *VALUES)),
    ]


def _generate(rng: random.Random, inputs: Path, out: Path) -> list[str]:
    return [
        *rng.choice(([_path(str(inputs / "set.toml"), rng, inputs)],) * 5 + (["--preset", rng.choice(VALUES)],)),
        *("-o", str(rng.choice((out, out, out, inputs / "run", inputs / "set"))), "--quiet"),
        *rng.choice((_sets(SET_KEYS, rng), _sets(SET_KEYS, rng), _sets(SCENE_KEYS, rng))),
        *_maybe("--device", rng, tuple(value.strip('"') for value in VALUES)),
        *_maybe("--extend", rng, ("train=3", "train=" + "9" * 12, "nope=3", *VALUES)),
        *_maybe("--most-failed", rng, VALUES),
        *_maybe("--check", rng),
    ]
