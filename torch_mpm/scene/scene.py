"""`Scene`: a scene file, or the same keys in Python."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from pathlib import Path
from typing import Any, get_args

import torch
from pydantic import PrivateAttr, ValidationError

from ..data.stress import MEASURES
from ..files import read_text
from ..geometry.seed import on_host
from . import check, partial, schema
from .build import Built, build
from .entry import ResolvedEntry
from .explain import SceneError, boolean_problems, explain, text_problems
from .fields import RANKS
from .places import relative

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

COSMETIC = {"title", "device", "render", "output"}


class Scene(schema.SceneData):
    """Scene to simulate. ``Scene.load("examples/jelly.toml")``, or the keys of a scene file as arguments:

        scene = mpm.Scene(
            grid=dict(lower=(0, 0), upper=(1, 1), dx=0.02),
            gravity=(0, -9.8),
            duration=1.0,
            material={"jelly": dict(law="neo_hookean", E=1e5, nu=0.3)},
            body=[dict(shape="sphere", center=(0.5, 0.5), radius=0.2, material="jelly")],
        )
        scene.run("out/jelly")

    Raises:
        SceneError: a ValueError with one line for each problem.
    """

    _folder: Path = PrivateAttr(default=Path())
    _source: str = PrivateAttr(default="")

    def __init__(self, **words: Any) -> None:
        if problems := text_problems(words):
            raise SceneError(problems)
        try:
            super().__init__(**words)
        except ValidationError as error:
            raise SceneError([*explain(error), *partial.problems(words)]) from None
        if problems := list(boolean_problems(words)):
            raise SceneError(problems)

    @classmethod
    def load(cls, path: str | Path, overrides: list[str] | None = None) -> Scene:
        """Read a scene file.

        Args:
            path: a TOML file.
            overrides: ``key=value`` with keys such as ``grid.dx`` or ``body[0].velocity`` and values as in TOML.

        Raises:
            SceneError: for problems in the file, with its name.
            FileNotFoundError: when there is no such file.
        """
        path = Path(path)
        return cls.from_words(parsed(path)[1], overrides, path.parent, str(path))

    @classmethod
    def from_words(
        cls, words: dict[str, Any], overrides: list[str] | None = None, folder: Path = Path(), source: str = ""
    ) -> Scene:
        """A scene from nested dictionaries.

        Args:
            words: the keys of a scene file.
            overrides: as for :meth:`load`; set in ``words``.
            folder: folder to which file names are relative.
            source: name of the file of the words, for messages.
        """
        try:
            for item in overrides or []:
                override(words, item)
        except SceneError as error:
            raise SceneError(error.problems, source) from None
        try:
            scene = cls(**words)
        except SceneError as error:
            raise SceneError([*error.problems, *partial.file_problems(words, folder)], source) from None
        scene._folder, scene._source = folder, source
        return scene

    @property
    def folder(self) -> Path:
        """Folder to which file names are relative."""
        return self._folder

    @property
    def source(self) -> str:
        """Name of the file that the scene was read from, for messages; "" for a scene created in Python."""
        return self._source

    @property
    def dim(self) -> int:
        return len(self.grid.lower)

    @property
    def frames(self) -> int:
        """Frames after the first."""
        return max(1, round(self.duration * self.fps))

    def time_of(self, frame: int) -> float:
        """Time of a frame [s]; the last one is at ``duration`` exactly."""
        return self.duration * frame / self.frames

    @property
    def trajectory_fields(self) -> list[str]:
        """Fields of the trajectory beside position and velocity: requested ones, and those that the other outputs
        need.
        """
        drawn = self.render.color_by if self.render else ""
        needed = {"stress": "von_mises_stress"}.get(drawn, drawn)
        names = {*self.output.fields, *([needed] if needed in RANKS else []), *self._deformations()}
        if self.output.vtk and "cauchy_stress" not in names:
            names.add("stress")
        if self.output.vtk and self.dim == 2:
            names.add("out_of_plane_stress")
        return [name for name in get_args(schema.StoredField) if name in names]

    def _deformations(self) -> set[str]:
        """Fields with the deformation of Gaussians."""
        bodies = [(entry, body) for entry in self.entries() for body in entry.body if body.shape == "splats"]
        materials = [entry.material.get(body.material) for entry, body in bodies]
        return {"J" if isinstance(words, schema.WeaklyCompressible) else "F" for words in materials}

    def torch_device(self) -> torch.device:
        """Raises SceneError for a device that does not exist."""
        name = self.device
        if name == "auto":
            name = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            device = torch.device(name)
        except RuntimeError:
            raise SceneError([f'device: takes "auto", "cpu" or "cuda", got {name!r}']) from None
        if device.type == "cuda" and not torch.cuda.is_available():
            raise SceneError([f'device: torch finds no CUDA device for {name!r}; use "cpu" or "auto"'])
        if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
            raise SceneError([f"device: there are {torch.cuda.device_count()} CUDA devices, got {name!r}"])
        return device

    def entries(self) -> list[ResolvedEntry]:
        """The scenes of the batch, each complete; one without a name for a file without [[scene]]."""
        if not self.scene:
            return [ResolvedEntry.resolved(self)]
        return [ResolvedEntry.resolved(entry, self, k) for k, entry in enumerate(self.scene)]

    def relative(self) -> Scene:
        """The same scene with all coordinates relative to its origin, which becomes zero."""
        if self.origin is None:
            return self
        moved: Scene = relative(self, self.origin).model_copy(update={"origin": None})
        return moved

    def fingerprint(self) -> str:
        """Hash of everything that determines the trajectory, including files.

        Raises:
            SceneError: for a file that cannot be read.
        """
        absent = {"origin"} if self.origin is None else set()  # As in files of versions without this key.
        digest = hashlib.sha256(self.model_dump_json(exclude=COSMETIC | absent).encode())
        names = self.trajectory_fields
        digest.update(json.dumps(names).encode())
        # Its default was different in earlier versions.
        digest.update(MEASURES["stress"].encode() if "stress" in names else b"")
        entries = self.entries()
        problems = [p for entry in entries for p in check.file_problems(entry, self.folder)]
        if problems:
            raise SceneError(problems, self.source)
        for entry in entries:
            for body in entry.body:
                if isinstance(body, schema.FileBody):
                    digest.update((self.folder / body.file).read_bytes())
        return digest.hexdigest()[:16]

    def build(self, device: str | torch.device | None = None) -> Built:
        """Seed the particles and assemble the step: an object with ``state``, ``step``, ``grid``.

        Raises:
            SceneError: for shapes outside the domain, overlapping bodies, a mesh that is not closed, more particles
                than memory holds, ...
        """
        try:
            with on_host():  # A scene is assembled on the CPU, for any default device of torch.
                return build(self, self.torch_device() if device is None else torch.device(device))
        except SceneError as error:
            raise SceneError(error.problems, self.source) from None

    def run(self, out: str | Path, **options: Any) -> dict[str, Any]:
        """Simulate into folder ``out`` and return the summary; ``options`` as in :func:`torch_mpm.scene.run`."""
        from .run import run

        return run(self, out, **options)


def parsed(path: Path) -> tuple[str, dict[str, Any]]:
    """Text and words of a TOML file.

    Raises:
        SceneError: for problems in the file, with its name.
        FileNotFoundError: when there is no such file.
    """
    try:
        text = read_text(path, "scene")
        return text, tomllib.loads(text)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise SceneError([str(error)]) from None
    except (ValueError, RecursionError) as error:
        raise SceneError([f"not a TOML file: {error}"], str(path)) from None


def _steps(key: str) -> list[str]:
    """Names and indices of the key of an override. A name in quotes may have dots and brackets, as in TOML."""
    quoted: list[str] = []

    def keep(found: re.Match[str]) -> str:
        quoted.append(found[0][1:-1])
        return f"\0{len(quoted) - 1}\0"

    plain = re.sub(r"""(?<![^.])(?:"[^"]*"|'[^']*')(?![^.\[])""", keep, key)
    steps = [step for part in plain.split(".") for step in part.replace("]", "").split("[")]
    return [re.sub(r"\0(\d+)\0", lambda found: quoted[int(found[1])], step) for step in steps]


def override(words: dict[str, Any], text: str) -> None:
    """Set a value of nested dictionaries by ``key=value``, as for `Scene.load`.

    Raises:
        SceneError: for another text, or an unknown key.
    """
    found = re.fullmatch(r"""((?:"[^"]*"|'[^']*'|[^"'=])*)=(.*)""", text, re.DOTALL)
    key, value = found.groups() if found else ("", "")
    steps = _steps(key.strip())
    if not all(steps):
        raise SceneError([f"override {text!r} must look like grid.dx=0.01"])
    try:
        parsed_value = tomllib.loads(f"value = {value}")
    except (ValueError, RecursionError):
        parsed_value = {"value": value.strip()}
    if len(parsed_value) > 1:
        raise SceneError([f"override {text!r} must have one value, got more keys: {', '.join([*parsed_value][1:])}"])
    given = parsed_value["value"]
    target: Any = words
    try:
        for step in steps[:-1]:
            if isinstance(target, dict) and target.get(step) is None:  # Absent, or null in the record of a run.
                target[step] = {}
            target = target[int(step)] if isinstance(target, list) else target[step]
        target[int(steps[-1]) if isinstance(target, list) else steps[-1]] = given
    except (KeyError, IndexError, ValueError, TypeError):
        raise SceneError([f"override {text!r}: there is no {key.strip()}"]) from None
