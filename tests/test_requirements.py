"""What the package needs: declared once, pinned once, used, and not under the GPL, the AGPL or the LGPL."""

import re
import sys
import tomllib
from importlib.metadata import distribution
from typing import Any

import pytest
from packaging.requirements import Requirement

from import_graph import PACKAGE, imported
from programs import ROOT
from sarsplat.extras import EXTRAS

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
COPYLEFT = re.compile(r"[AL]?GPL|GNU (Affero |Lesser |Library )?General Public", re.IGNORECASE)


def licence(metadata: Any) -> str:
    """What a distribution says of itself. A whole licence text may quote others, so only its beginning counts."""
    classifiers = [line for line in metadata.get_all("Classifier") or [] if line.startswith("License :: ")]
    return metadata.get("License-Expression") or "; ".join(classifiers) or (metadata.get("License") or "").strip()[:200]


def is_copyleft(licence: str) -> bool:
    """Whether none of the licences to choose from is without copyleft."""
    return all(COPYLEFT.search(choice) for choice in licence.split(" OR "))


def needed(*others: str) -> dict[str, str]:
    """The licence of everything that the package and its extras bring here, by name, but for these extras."""
    optional = PROJECT["optional-dependencies"]
    extras = {name: lines for name, lines in optional.items() if name not in ("all", "dev", *others)}
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


@pytest.mark.parametrize("others", [("ray", "docs"), ("ray",)], ids=["of users", "of the documentation, too"])
def test_nothing_needed_is_copyleft(others):
    if "docs" not in others:
        pytest.importorskip("material", reason="the extra `docs` is not installed")
    licences = needed(*others)
    assert {"torch", "numpy", "matplotlib", "sympy"} <= licences.keys()  # what others need included
    assert all(licences.values()), [name for name, words in licences.items() if not words]
    assert not {name: words for name, words in licences.items() if is_copyleft(words)}


def test_copyleft_is_recognised():
    lesser = "License :: OSI Approved :: GNU Lesser General Public License v3"
    assert all(map(is_copyleft, ("GPL-3.0-or-later", "AGPL-3.0-only", "LGPLv2+", lesser)))
    assert not any(map(is_copyleft, ("Apache-2.0", "MIT OR GPL-2.0-only", "BSD-3-Clause AND MIT")))


def test_the_extras_in_the_code_are_those_of_the_package():
    for extra, modules in EXTRAS.items():
        assert {requirement.partition(">")[0] for requirement in PROJECT["optional-dependencies"][extra]} == set(
            modules.values()
        )


def test_no_requirement_is_declared_twice():
    for lines in (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()):
        names = [re.split(r"[>=\[; ]", line)[0] for line in lines]
        assert len(set(names)) == len(names), names


def test_core_dependencies_are_declared_and_used():
    declared = {requirement.partition(">")[0] for requirement in PROJECT["dependencies"]}
    extras = {module for modules in EXTRAS.values() for module in modules}
    used = {module.partition(".")[0] for path in PACKAGE.rglob("*.py") for module in imported(path)}
    assert used - {"sarsplat", *sys.stdlib_module_names} - extras == declared


def test_each_package_is_pinned_once_and_sections_are_alphabetical():
    sections = [section.splitlines() for section in (ROOT / "constraints.txt").read_text().split("\n\n")[1:]]
    assert all(section[0].startswith("# ") for section in sections)
    names = [[line.partition("==")[0] for line in section[1:]] for section in sections]
    assert names == [sorted(section) for section in names]
    everything = [name for section in names for name in section]
    assert len(everything) == len(set(everything))
