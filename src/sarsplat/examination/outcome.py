"""The result of examining a dataset: contradictions, checks, and a table of orientations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Examination:
    """The result of examining a dataset.

    Attributes
    ----------
    contradictions : list of str
        What contradicts the dataset's own statements: one sentence each, with the remedy. Empty if nothing does.
    checks : dict of str to str
        What was looked at, and what there was to see, or why nothing can be said.
    orientations : list of (str, ...)
        A table of the eight orientations and what speaks for each, its head first; empty if they were not looked at.
    """

    contradictions: list[str] = field(default_factory=list)
    checks: dict[str, str] = field(default_factory=dict)
    orientations: list[tuple[str, ...]] = field(default_factory=list)

    def conclude(self, check: str, wrong: Sequence[str], otherwise: str) -> None:
        """Add the contradictions that one check found, or, if there are none, what there was to see."""
        self.contradictions.extend(wrong)
        self.checks[check] = "see below" if wrong else otherwise
