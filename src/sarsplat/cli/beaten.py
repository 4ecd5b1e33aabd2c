"""What to say before a run is used that is worse than what needs no third dimension."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sarsplat.cli import console


def warn_if_beaten(metrics: Mapping[str, Any] | None) -> None:
    """Warn of every test set on which a baseline is better; scores of another version are passed over."""
    if metrics is None:
        return
    from sarsplat.evaluation import beaten_by_baselines

    try:
        sentences = beaten_by_baselines(metrics)
    except (KeyError, TypeError, AttributeError, ValueError):
        return
    for sentence in sentences:
        console.warn(sentence)
