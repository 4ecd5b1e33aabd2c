"""Plan of a sweep: datasets, methods, settings and seeds to combine, read from a TOML file."""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from glob import escape, glob
from itertools import product
from pathlib import Path
from typing import Any, Literal, Self

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError, shown
from sarsplat.settings.config import DEFAULT_METHOD
from sarsplat.settings.kinds import Seed
from sarsplat.settings.record import Record, dotted

_MARK = "dataset.json"
_OWN = {"seed": "seeds", "preset": "preset"}  # settings that are keys of a plan, with these keys


@dataclass(frozen=True)
class Plan(Record):
    """Combinations of datasets, methods, settings and seeds that a sweep does.

    Parameters
    ----------
    datasets : tuple of str
        Patterns of folders, such as ``data/*``, below the folder of the plan; other folders than datasets are skipped.
    methods : tuple of str or dict
        Names of methods; or a table for each method, with settings of that method alone.
    preset : str or tuple of str
        Starting settings, as of `sarsplat.reconstruct`.
    seeds : tuple of int
        Seeds of each combination; results are means and spreads over them.
    settings : dict
        Settings of every method, by their names on the command line; every list is swept.
    device : str
        "cpu" or "cuda". Their results differ in the last bits, so the device is part of a run's address.
    masks : str or None
        Folder of masks, as of `sarsplat reconstruct` and `evaluate`; None: the dataset's own, if it has any.
    mesh : str or None
        Model of the target, as of `sarsplat evaluate`.
    align : str
        "rigid" or "none", as of `sarsplat evaluate`.
    reports : bool
        Write a report of every run.
    parts : tuple of dict
        Plans in the plan: each inherits the plan's keys and overrides some; `name` is its label in tables.
    name : str
        Label of a part.

    Raises
    ------
    SarsplatError
        If a key is unknown or a value is invalid.
    """

    datasets: tuple[str, ...]
    methods: tuple[str, ...] | dict[str, dict[str, Any]] = (DEFAULT_METHOD,)
    preset: str | tuple[str, ...] = "auto"
    seeds: tuple[Seed, ...] = (0,)
    settings: dict[str, Any] = field(default_factory=dict)
    device: Literal["cpu", "cuda"] = "cpu"
    masks: str | None = None
    mesh: str | None = None
    align: Literal["none", "rigid"] = "none"
    reports: bool = True
    parts: tuple[dict[str, Any], ...] = ()
    name: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        for one in ("datasets", "methods", "preset", "seeds"):
            value = getattr(self, one)
            if len(value) == 0:
                raise SarsplatError(f"{one} is empty; give at least one")
            if isinstance(value, tuple) and len(set(value)) < len(value):
                raise SarsplatError(f"{one} is {shown(list(value))}, the same twice; give each once")
        for setting in [name for _, settings in self.each_method() for name in settings]:
            if setting in _OWN:
                raise SarsplatError(f"{setting} is a key of the plan, not a setting; give {_OWN[setting]} instead")

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a plan from a TOML file."""
        with open_file(path) as file:
            try:
                data = tomllib.loads(file.read().decode())
            except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
                raise SarsplatError(f"{path} is not a TOML file ({error}); correct it") from error
        return cls.from_dict(data, str(path))

    def on(self, device: str) -> Self:
        """Copy of the plan and its parts for another device, "cpu" or "cuda"."""
        return replace(self, device=device, parts=tuple({**part, "device": device} for part in self.parts))  # type: ignore[arg-type]

    def each_part(self) -> "Iterator[Plan]":
        """The plan itself, or its parts."""
        if not self.parts:
            yield self
        own = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "parts"}
        for index, part in enumerate(self.parts):
            merged = {**own, "name": f"part {index + 1}", **part}
            merged["settings"] = {**self.settings, **part.get("settings", {})}
            yield type(self).from_dict(merged, f"parts[{index}]")

    def each_method(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """The name of every method with its settings, whose names are dotted."""
        common = dict(dotted(self.settings))
        own = self.methods if isinstance(self.methods, Mapping) else {name: {} for name in self.methods}
        for name, settings in own.items():
            yield name, common | dict(dotted(settings))

    def each_choice(self, settings: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
        """Every preset with every combination of the swept values."""
        values = [value if isinstance(value, list) else [value] for value in settings.values()]
        for name, several in zip(settings, values, strict=True):
            if not several:
                raise SarsplatError(f"the setting {name} is an empty list, so there is nothing to do; give its values")
        for preset in (self.preset,) if isinstance(self.preset, str) else self.preset:
            for chosen in product(*values):
                yield preset, dict(zip(settings, chosen, strict=True))

    def folders(self, base: Path) -> dict[Path, str]:
        """Folders of the datasets that match the patterns below `base`, with short unique names."""
        found: dict[Path, None] = {}
        for pattern in self.datasets:
            where = str(Path(escape(str(base))) / pattern)  # may be absolute, unlike the patterns of `Path.glob`
            matched = sorted(map(Path, glob(where, recursive=True, include_hidden=True)))  # noqa: PTH207
            matched = [path for path in matched if (path / _MARK).is_file()] if pattern.strip("./") else [base]
            if not matched:
                raise SarsplatError(f"no dataset is at {base / pattern}; correct the pattern {shown(pattern)}")
            found |= dict.fromkeys(path.resolve() for path in matched)
        names = [path.name for path in found]
        return {path: path.name if names.count(path.name) == 1 else str(path) for path in found}

    def at(self, base: Path) -> Self:
        """Copy with absolute paths of masks and mesh, which are relative to `base`."""

        def absolute(path: str | None) -> str | None:
            return None if path is None else str((base / path).resolve())

        return replace(self, masks=absolute(self.masks), mesh=absolute(self.mesh))
