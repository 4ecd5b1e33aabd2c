"""What people call runs whose folders' names say nothing: their datasets, and what differs between them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from sarsplat.runs.run_folder import Header, read_header


def says_nothing(folder: Path) -> bool:
    """Whether a run's folder has no name but an address, as sweeps give them."""
    return re.fullmatch(r"[0-9a-f]{16}", folder.name) is not None


def names_of(folders: Sequence[Path]) -> list[str]:
    """What to call runs: their folders' names, or what differs where these say nothing; paths where that coincides."""
    nameless = [folder for folder in folders if says_nothing(folder)]
    known = dict(zip(nameless, told_apart([read_header(folder) for folder in nameless]), strict=True))
    names = [known.get(folder, folder.absolute().name) for folder in folders]
    return names if len({*names}) == len(names) else [str(folder) for folder in folders]


def told_apart(headers: Sequence[Header], with_method: bool = True) -> list[str]:
    """A name for each run: its dataset, its seed, and what of method, preset and settings is not that of all.

    Settings are told of runs of one dataset, method and preset: others differ in most of them. Of a section that others
    do not have, the name is told.
    """
    methods = {header.method for header in headers}
    presets = {header.config["preset"] for header in headers if "preset" in header.config}  # other methods have none
    datasets: dict[str, set[str]] = {}  # by their folders' names
    values: dict[tuple[str, str, str], dict[str, list[str]]] = {}  # of each setting, of runs that differ in little
    for header in headers:
        datasets.setdefault(Path(_dataset(header)).name, set()).add(_dataset(header))
        known = values.setdefault(_kind(header), {})
        for name, value in _dotted(header.config):
            known.setdefault(name, []).append(str(value))
    alike = Counter(map(_kind, headers))
    names = []
    for header in headers:
        name = Path(_dataset(header)).name if len(datasets[Path(_dataset(header)).name]) == 1 else _dataset(header)
        words = [name or "images in memory"]
        words += [header.method] if with_method and len(methods) > 1 else []
        words += [header.config["preset"]] if len(presets) > 1 and "preset" in header.config else []
        settings = ((name, value) for name, value in _dotted(header.config) if name not in ("preset", "seed"))
        for setting, value in settings:
            given, (section, dot, _) = values[_kind(header)][setting], setting.partition(".")
            if len({*given}) > 1 or (len(given) < alike[_kind(header)] and not dot):
                words.append(f"{setting} {value}")
            elif len(given) < alike[_kind(header)] and section not in words:
                words.append(section)
        words += [f"seed {header.config['seed']}"] if "seed" in header.config else []
        names.append(", ".join(words))
    return names


def _kind(header: Header) -> tuple[str, str, str]:
    return _dataset(header), header.method, str(header.config.get("preset"))


def _dataset(header: Header) -> str:
    return header.dataset or ""


def _dotted(settings: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _dotted(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value
