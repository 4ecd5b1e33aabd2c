"""Result of an examination: contradictions, checks, and a table of orientations."""

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Examination:
    """Result of examining a dataset."""

    contradictions: list[str] = field(default_factory=list)
    """Contradictions to the dataset's metadata, each a sentence with its remedy."""
    checks: dict[str, str] = field(default_factory=dict)
    """Check → its finding, or the reason for no finding."""
    orientations: list[tuple[str, ...]] = field(default_factory=list)
    """Table of the eight orientations with the evidence for each, head first; empty if not examined."""

    def conclude(self, check: str, wrong: Sequence[str], otherwise: str) -> None:
        """Add the contradictions that one check found, or else its finding."""
        self.contradictions.extend(wrong)
        self.checks[check] = "see below" if wrong else otherwise
