"""The pinned versions: each package once, where one looks for it."""

from __future__ import annotations

from pathlib import Path

CONSTRAINTS = Path(__file__).parents[1] / "constraints.txt"


def test_each_package_is_pinned_once_and_sections_are_alphabetical():
    sections = [section.splitlines() for section in CONSTRAINTS.read_text().split("\n\n")[1:]]
    assert all(section[0].startswith("# ") for section in sections)
    names = [[line.partition("==")[0] for line in section[1:]] for section in sections]
    assert names == [sorted(section) for section in names]
    everything = [name for section in names for name in section]
    assert len(everything) == len(set(everything))
