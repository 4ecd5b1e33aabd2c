"""Readable names of runs: folder names or, for hashed folders of sweeps, dataset and differing settings."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from sarsplat.runs.run_folder import Header, read_header


def is_hashed(folder: Path) -> bool:
    """Return whether a run's folder has a hash for a name, as in sweeps."""
    return re.fullmatch(r"[0-9a-f]{16}", folder.name) is not None


def names_of(folders: Sequence[Path]) -> list[str]:
    """Return names of runs: folder names, or distinguishing names of hashed folders; paths if these coincide."""
    hashed = [folder for folder in folders if is_hashed(folder)]
    values_of_kind = dict(zip(hashed, distinguished([read_header(folder) for folder in hashed]), strict=True))
    names = [values_of_kind.get(folder, folder.absolute().name) for folder in folders]
    return names if len({*names}) == len(names) else [str(folder) for folder in folders]


def distinguished(headers: Sequence[Header], with_method: bool = True) -> list[str]:
    """Name each run by dataset, differing method, preset and settings, and seed.

    Settings are compared between runs of one dataset, method and preset, as others differ in most. A section that other
    runs lack is named without its settings.
    """
    methods = {header.method for header in headers}
    presets = {header.config["preset"] for header in headers if "preset" in header.config}  # only of sar-gs
    datasets: dict[str, set[str]] = {}  # folder name → paths
    values: dict[tuple[str, str, str], dict[str, list[str]]] = {}  # kind → setting → values
    for header in headers:
        datasets.setdefault(Path(_dataset(header)).name, set()).add(_dataset(header))
        values_of_kind = values.setdefault(_kind(header), {})
        for name, value in _dotted(header.config):
            values_of_kind.setdefault(name, []).append(str(value))
    kind_counts = Counter(map(_kind, headers))
    names = []
    for header in headers:
        name = Path(_dataset(header)).name if len(datasets[Path(_dataset(header)).name]) == 1 else _dataset(header)
        words = [name or "images in memory"]
        words += [header.method] if with_method and len(methods) > 1 else []
        words += [header.config["preset"]] if len(presets) > 1 and "preset" in header.config else []
        settings = ((name, value) for name, value in _dotted(header.config) if name not in ("preset", "seed"))
        for setting, value in settings:
            given, (section, dot, _) = values[_kind(header)][setting], setting.partition(".")
            if len({*given}) > 1 or (len(given) < kind_counts[_kind(header)] and not dot):
                words.append(f"{setting} {value}")
            elif len(given) < kind_counts[_kind(header)] and section not in words:
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
