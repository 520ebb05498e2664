"""Configurations of data sets: scene files whose values may be distributions, and a table `[dataset]`.

    [dataset]
    splits = { train = 1000, valid = 30, test = 30 }
    frames = 321
    interval = 0.0025

    [grid] ...                       # and all other shared keys of a scene file

    [material.sand]                  # may differ between scenes, as gravity, bodies and obstacles
    law = "quartic_sand"
    E = { log_uniform = [1e5, 1e6] }

    [[body]]
    count = { integers = [1, 3] }    # a body, or an obstacle, may be repeated
    shape = "box"
    center = { in_box = [[0.1, 0.1], [0.9, 0.9]] }
    size = [{ uniform = [0.1, 0.3] }, 0.2]
    material = "sand"

Bodies and obstacles have the keys of scene files, and `count`. A box may have `center` and `size` instead of corners, a
capsule or a cylinder `center` and `axis`, from end to end, instead of its ends.
"""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError

from ..files import check_file
from ..scene import Scene, SceneError, schema
from ..scene.check import corner_problems
from ..scene.explain import boolean_problems, explain, text_problems
from ..scene.scene import override, parsed
from . import distribution
from .content_checks import shape_problems, value_problems
from .distribution import Words
from .folder import MOST_SHARDS
from .scene_words import number_problems
from .statistics import BOUNDARY
from .stress import MEASURES
from .whole_files import LONGEST_NAME, is_name

FORMAT = 2
"""Version, increased whenever the same configuration would give other scenes."""
VARIED = ("gravity", "material", "body", "obstacle")
"""Keys of a scene file that may differ between scenes."""
ABSENT = {
    "duration": "give [dataset] frames and interval instead",
    "fps": "give [dataset] frames and interval instead",
    "seed": "give [dataset] seed instead",
    "scene": "the scenes of a data set are samples of one distribution",
    "origin": "give all coordinates relative to it instead, as models learn from positions in float32",
    "emitter": "the scenes of a data set have all their particles from the start; use bodies",
    "output": "give [dataset] fields instead",
    "render": "export a scene and draw it instead",
}
COSMETIC = ("title", "device")
PARTICLE_TYPES = {"weakly_compressible": 5, "quartic_sand": 6}
"""DeepMind's codes by law: water and sand; all others are goop."""
GOOP = 7


def _checked_name(name: str) -> str:
    if not is_name(name):
        letters = f"at most {LONGEST_NAME} letters, digits, - and _ that are not the name of a device such as con"
        raise ValueError(f"takes a name of {letters}")
    return name


Name = Annotated[str, AfterValidator(_checked_name)]
Code = Annotated[int, Field(ge=0, le=8)]


class Dataset(schema.Model):
    """Table `[dataset]` of a configuration."""

    splits: Annotated[dict[Name, Annotated[int, Field(ge=0)]], Field(min_length=1)]
    """numbers of scenes by the name of a split, such as { train = 1000, valid = 30, test = 30 }"""
    frames: Annotated[int, Field(ge=2)]
    """number of frames of a scene, including the first"""
    interval: schema.Positive
    """time from frame to frame [s]"""
    fields: list[Literal["velocity"] | schema.StoredField] = Field(default_factory=list)
    """what is stored beside positions; stress is another name of cauchy_stress"""
    seed: Annotated[int, Field(ge=0)] = 0
    """seed of the data set"""
    particles: Annotated[int, Field(ge=1)] | None = None
    """exact number of particles of a scene, shared by its bodies by their volumes; by default per_cell decides"""
    gap: schema.NotNegative | None = None
    """least distance of bodies from each other and from obstacles [m]; by default grid.dx"""
    scenes_per_shard: Annotated[int, Field(ge=1, le=MOST_SHARDS)] = 16
    """scenes of a file, which are simulated together; as many as the device holds are fastest"""
    attempts: Annotated[int, Field(ge=1, le=10)] = 3
    """how often a scene is tried, each time with a smaller time step, before it is recorded as failed"""
    obstacles: bool = True
    """whether obstacles are in the data as particles of type 3, a layer below their surface that moves with them"""
    particle_type: dict[str, Code] = Field(default_factory=dict)
    """particle types of materials; by default 5 (water), 6 (sand) or 7 (goop) by their laws"""


@dataclass(frozen=True)
class Configuration:
    """A configuration that was read and checked.

    Attributes:
        words: all keys of the file.
        dataset: its table `[dataset]`.
        text: the file unchanged, below comments with the overrides; or the words as JSON without a file.
        folder: folder to which file names are relative.
        source: name of the file, for messages.
        hash: hash of everything that determines the scenes; 64 hexadecimal digits.
    """

    words: Words
    dataset: Dataset
    text: str
    folder: Path
    source: str
    hash: str

    @classmethod
    def load(cls, path: str | Path, overrides: list[str] | None = None) -> Configuration:
        """Read a configuration.

        Args:
            path: a TOML file.
            overrides: as for `Scene.load`, such as ``dataset.frames=20``.

        Raises:
            SceneError: with one line for each problem.
            FileNotFoundError: when there is no such file.
        """
        path = Path(path)
        text, words = parsed(path)
        return cls.from_words(words, overrides, path.parent, str(path), text)

    @classmethod
    def preset(cls, name: str, overrides: list[str] | None = None) -> Configuration:
        """One of `presets`.

        Raises:
            SceneError: for an unknown name, or wrong overrides.
        """
        if name not in presets():
            raise SceneError([f"takes one of {', '.join(presets())}, got {name!r}"], "preset")
        with resources.as_file(_presets() / f"{name}.toml") as path:
            return cls.load(path, overrides)

    @classmethod
    def from_words(
        cls, words: Words, overrides: list[str] | None = None, folder: Path = Path(), source: str = "", text: str = ""
    ) -> Configuration:
        """Configuration of nested dictionaries; arguments and errors as for `load`."""
        words = copy.deepcopy(words)
        try:
            for item in overrides or []:
                override(words, item)
            dataset = _checked(words)
            digest = _hash(words, folder)
        except SceneError as error:
            raise SceneError(error.problems, source) from None
        if text:
            text = "".join("# --set " + item.replace("\n", "\n# ") + "\n" for item in overrides or []) + text
        else:
            text = json.dumps(words, indent=1)
        return cls(words, dataset, text, folder, source, digest)

    @property
    def dim(self) -> int:
        return len(self.words["grid"]["lower"])

    @property
    def scenes(self) -> int:
        """Number of scenes of all splits."""
        return sum(self.dataset.splits.values())

    @property
    def splits(self) -> dict[str, tuple[int, int]]:
        """First id and number of scenes by the name of a split."""
        first, found = 0, {}
        for name, count in self.dataset.splits.items():
            found[name] = (first, count)
            first += count
        return found

    def scene_words(self, *contents: Words) -> Words:
        """Scene file of one content, or of the batch of several, as drawn by `torch_mpm.data.sampling`."""
        dataset = self.dataset
        time = {"duration": (dataset.frames - 1) * dataset.interval, "fps": 1 / dataset.interval}
        shared = {key: value for key, value in self.words.items() if key not in (*VARIED, "dataset")}
        own = contents[0] if len(contents) == 1 else {"scene": list(contents)}
        return {**shared, **time, **own}

    def scene(self, *contents: Words) -> Scene:
        """The scene of `scene_words`.

        Raises:
            SceneError: for problems in them.
        """
        words = self.scene_words(*contents)
        if problems := number_problems(words):
            raise SceneError(problems, self.source)
        return Scene.from_words(words, folder=self.folder, source=self.source)

    @property
    def drawn_parameters(self) -> list[str]:
        """Names of the parameters of materials that differ between scenes."""
        names = set()
        for material in self.words.get("material", {}).values():
            names |= {key for key, value in material.items() if distribution.is_distribution(value)}
            for chosen in material.get(distribution.CHOICE, []):
                names |= {key for key, value in chosen.items() if value is not None}
        return sorted(names - {distribution.CHOICE, distribution.WEIGHTS})

    def particle_type(self, material: Any) -> int:
        """DeepMind's code for a material (`scene.build.Material`)."""
        return self.dataset.particle_type.get(material.name, PARTICLE_TYPES.get(material.words.law, GOOP))


def presets() -> list[str]:
    """Names of the configurations that come with torch_mpm."""
    return sorted(p.name.removesuffix(".toml") for p in _presets().iterdir() if p.name.endswith(".toml"))


def _presets() -> Any:
    return resources.files(__package__) / "presets"


# ---- checks


def _checked(words: Words) -> Dataset:
    """Table [dataset] of words without problems that are visible without a sample.

    Raises:
        SceneError: for problems.
    """
    problems = [f"{key}: is not for data sets; {remedy}" for key, remedy in ABSENT.items() if key in words]
    problems += [*text_problems(words), *boolean_problems(words)]
    misshapen = list(shape_problems(words))
    problems += misshapen
    dataset = None
    try:
        dataset = Dataset(**words["dataset"])
    except ValidationError as error:
        problems += [f"dataset.{line}" for line in explain(error, Dataset)]
    except (KeyError, TypeError):
        problems.append("dataset: missing; takes a table with splits, frames and interval")
    shared = {key: value for key, value in words.items() if key not in VARIED}
    for key in distribution.found(shared):
        problems.append(f"{key}: takes no distribution; only these may differ between scenes: {', '.join(VARIED)}")
    try:
        grid = schema.Grid(**words["grid"])
    except (ValidationError, KeyError, TypeError):
        grid = None  # The first sample will show it.
    if grid is not None:
        problems += corner_problems(grid)
        for key in VARIED:
            problems += distribution.problems(words.get(key), key, len(grid.lower))
    if not misshapen:
        problems += value_problems(words, bool(dataset and dataset.particles), bool(dataset and dataset.obstacles))
    if problems or dataset is None:
        raise SceneError(problems)
    if grid is None:
        Scene(**{key: value for key, value in words.items() if key not in (*VARIED, "dataset")})
        raise SceneError(["grid: missing"])
    names = words.get("material", {})
    if unknown := [name for name in dataset.particle_type if name not in names]:
        expected = f"takes names of materials, {', '.join(names)}"
        raise SceneError([f"dataset.particle_type.{name}: {expected}" for name in unknown])
    if bounds := [name for name, code in dataset.particle_type.items() if code == BOUNDARY]:
        expected = f"takes 0 to 8 but for {BOUNDARY}, the type of obstacles, whose motion is given"
        raise SceneError([f"dataset.particle_type.{name}: {expected}" for name in bounds])
    if same := _names_of_one_file(dataset.splits):
        raise SceneError([f"dataset.splits: {' and '.join(same)} differ in upper case alone, and would share files"])
    if "temperature" in dataset.fields and "heat" not in words:
        raise SceneError(["dataset.fields: temperature needs a [heat] table"])
    if "out_of_plane_stress" in dataset.fields and len(grid.lower) == 3:
        raise SceneError(["dataset.fields: out_of_plane_stress is for 2-D; in 3-D the stress has all components"])
    if (shards := -(-sum(dataset.splits.values()) // dataset.scenes_per_shard)) > MOST_SHARDS:
        most = f"{MOST_SHARDS} are allowed; have fewer scenes, or more scenes_per_shard"
        raise SceneError([f"dataset.splits: {shards} shards would be made, and {most}"])
    if not sum(dataset.splits.values()):
        raise SceneError([f"dataset.splits: has no scenes, got {dataset.splits}"])
    return dataset


def _names_of_one_file(names: Iterable[str]) -> list[str]:
    """Names that are one on file systems that ignore the case of letters; empty without such names."""
    found: dict[str, list[str]] = {}
    for name in names:
        found.setdefault(name.casefold(), []).append(name)
    return next((same for same in found.values() if len(same) > 1), [])


def _hash(words: Words, folder: Path) -> str:
    kept = {key: value for key, value in words.items() if key not in COSMETIC}
    measure = MEASURES["stress"] if "stress" in words["dataset"].get("fields", []) else ""  # Only after another one.
    digest = hashlib.sha256(f"{FORMAT} {measure}{json.dumps(kept)}".encode())
    for key, name in _files(words.get("body"), "body"):
        try:
            check_file(folder / name, "shape")
        except OSError as error:
            raise SceneError([f"{key}: {error}"]) from None
        digest.update((folder / name).read_bytes())
    return digest.hexdigest()


def _files(words: Any, path: str) -> Iterator[tuple[str, str]]:
    """(key, name) of all files in words."""
    if isinstance(words, dict):
        for key, value in words.items():
            if key != "file":
                yield from _files(value, f"{path}.{key}")
            else:
                names = value.get("choice", []) if isinstance(value, dict) else [value]
                yield from ((f"{path}.file", name) for name in names if isinstance(name, str))
    elif isinstance(words, list):
        for k, item in enumerate(words):
            yield from _files(item, f"{path}[{k}]")
