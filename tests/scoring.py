"""Scores and reports of small targets: by the same protocol with fewer samples, in a hundredth of the time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest


@contextmanager
def few_samples() -> Iterator[None]:
    """Runs are scored with 5000 samples of each surface instead of a million, and shown in fewer pixels."""
    from sarsplat.evaluation.surface import visible_surface

    def coarse(mesh: Any, views: Any, ray_spacing: float, each_view: Any) -> Any:
        return visible_surface(mesh, views, ray_spacing=5 * ray_spacing, samples=5000, each_view=each_view)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sarsplat.evaluation.evaluate.visible_surface", coarse)
        patch.setattr("sarsplat.evaluation.evaluate._MESH_SAMPLES", 5000)
        patch.setattr("sarsplat.report.write._SURFACE_SAMPLES", 500)
        patch.setattr("sarsplat.report.boards._PIXELS", 40)
        patch.setattr("sarsplat.report.widget._MOST_RENDERED", 3000)
        yield
