"""A plan: which datasets, methods, settings and seeds a sweep combines, read from a TOML file."""

from __future__ import annotations

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
from sarsplat.settings.record import Record

_MARK = "dataset.json"
_OWN = {"seed": "seeds", "preset": "preset"}
"""Settings that are said elsewhere in a plan."""


@dataclass(frozen=True)
class Plan(Record):
    """What a sweep does: every combination of what is listed.

    Parameters
    ----------
    datasets : tuple of str
        Patterns of folders, such as ``data/*``, below the folder of the plan; what is no dataset is skipped.
    methods : tuple of str or dict
        Names of methods; or a table for each of them, with settings of that method alone.
    preset : str or tuple of str
        Starting settings, as of `sarsplat.reconstruct`.
    seeds : tuple of int
        Each combination is done with each of them; results are means and spreads over them.
    settings : dict
        Settings of every method, by their names on the command line; every list is swept.
    device : str
        "cpu" or "cuda": its results differ in their last bits, so it is a part of what was done.
    masks : str or None
        Folder of masks, as of `sarsplat reconstruct` and `evaluate`; None: the dataset's own, if it has any.
    mesh : str or None
        Model of the target, as of `sarsplat evaluate`.
    align : str
        "rigid" or "none", as of `sarsplat evaluate`.
    reports : bool
        Whether every run gets its report.
    parts : tuple of dict
        Plans in the plan: each has the plan's keys and its own, which count more; `name` is what tables call it.
    name : str
        Of a part.

    Raises
    ------
    SarsplatError
        If a key is unknown or a value is not what it must be.
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
                raise SarsplatError(f"the setting {setting} is not one of `settings`; give {_OWN[setting]} instead")

    @classmethod
    def read(cls, path: Path) -> Self:
        """The plan in a TOML file, or a SarsplatError."""
        return cls.from_dict(read_toml(path), str(path))

    def on(self, device: str) -> Self:
        """The same on another device, "cpu" or "cuda"; its parts, too."""
        return replace(self, device=device, parts=tuple({**part, "device": device} for part in self.parts))  # type: ignore[arg-type]

    def each_part(self) -> Iterator[Plan]:
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
        common = dict(_dotted(self.settings))
        own = self.methods if isinstance(self.methods, Mapping) else {name: {} for name in self.methods}
        for name, settings in own.items():
            yield name, common | dict(_dotted(settings))

    def each_choice(self, settings: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
        """Every preset with every combination of the values of what is swept."""
        values = [value if isinstance(value, list) else [value] for value in settings.values()]
        for name, several in zip(settings, values, strict=True):
            if not several:
                raise SarsplatError(f"the setting {name} is an empty list, so there is nothing to do; give its values")
        for preset in (self.preset,) if isinstance(self.preset, str) else self.preset:
            for chosen in product(*values):
                yield preset, dict(zip(settings, chosen, strict=True))

    def folders(self, base: Path) -> dict[Path, str]:
        """The datasets that the patterns mean, below a folder, with short names that differ."""
        found: dict[Path, None] = {}
        for pattern in self.datasets:
            where = str(Path(escape(str(base))) / pattern)  # an absolute pattern as it is, which `Path.glob` refuses
            matched = sorted(map(Path, glob(where, recursive=True, include_hidden=True)))  # noqa: PTH207
            matched = [path for path in matched if (path / _MARK).is_file()] if pattern.strip("./") else [base]
            if not matched:
                raise SarsplatError(
                    f"no dataset is at {base / pattern}; correct the pattern {shown(pattern)} of `datasets`"
                )
            found |= dict.fromkeys(path.resolve() for path in matched)
        names = [path.name for path in found]
        return {path: path.name if names.count(path.name) == 1 else str(path) for path in found}

    def at(self, base: Path) -> Self:
        """The same with paths of files that do not depend on the current folder."""

        def there(path: str | None) -> str | None:
            return None if path is None else str((base / path).resolve())

        return replace(self, masks=there(self.masks), mesh=there(self.mesh))


def read_toml(path: Path) -> dict[str, Any]:
    """What a TOML file holds, be it a plan or not."""
    with open_file(path) as file:
        try:
            return tomllib.loads(file.read().decode())
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise SarsplatError(f"{path} is not a TOML file ({error}); correct it") from error


def _dotted(settings: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """`rates.means` for tables in tables."""
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _dotted(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value
