"""Nothing that the package or its extras need is under the GPL, the AGPL or the LGPL."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import PackageMetadata, distribution
from pathlib import Path

from packaging.requirements import Requirement

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
COPYLEFT = re.compile(r"[AL]?GPL|GNU (Affero |Lesser |Library )?General Public", re.IGNORECASE)


def licence(metadata: PackageMetadata) -> str:
    """What a distribution says of itself. A whole licence text may quote others, so only its beginning counts."""
    classifiers = [line for line in metadata.get_all("Classifier") or [] if line.startswith("License :: ")]
    return metadata.get("License-Expression") or "; ".join(classifiers) or (metadata.get("License") or "").strip()[:200]


def is_copyleft(licence: str) -> bool:
    """Whether none of the licences to choose from is without copyleft."""
    return all(COPYLEFT.search(choice) for choice in licence.split(" OR "))


def needed() -> dict[str, str]:
    """The licence of everything that `pip install 'sarsplat[all]'` brings here, by name."""
    extras = {name: lines for name, lines in PROJECT["optional-dependencies"].items() if name not in ("all", "dev")}
    waiting = [(Requirement(line), {""}) for lines in (PROJECT["dependencies"], *extras.values()) for line in lines]
    seen, licences = set(), {}
    while waiting:
        requirement, asked_for = waiting.pop()
        if requirement.marker and not any(requirement.marker.evaluate({"extra": name}) for name in asked_for):
            continue  # for another platform, or an extra that nobody asked for
        if (key := (requirement.name.lower(), frozenset(requirement.extras))) in seen:
            continue
        seen.add(key)
        found = distribution(requirement.name)
        licences[found.metadata["Name"]] = licence(found.metadata)
        waiting += [(Requirement(line), {"", *requirement.extras}) for line in found.requires or []]
    return licences


def test_nothing_needed_is_copyleft():
    licences = needed()
    assert {"torch", "numpy", "matplotlib", "sympy"} <= licences.keys()  # what others need included
    assert all(licences.values()), [name for name, words in licences.items() if not words]
    assert not {name: words for name, words in licences.items() if is_copyleft(words)}


def test_copyleft_is_recognised():
    for words in (
        "GPL-3.0-or-later",
        "AGPL-3.0-only",
        "LGPLv2+",
        "License :: OSI Approved :: GNU Lesser General Public License v3",
    ):
        assert is_copyleft(words), words
    for words in ("Apache-2.0", "MIT OR GPL-2.0-only", "BSD-3-Clause AND MIT"):
        assert not is_copyleft(words), words
