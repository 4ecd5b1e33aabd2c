"""Tilted and left-looking datasets: what is right passes, what is wrong is found, and twins are named."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_contradictions import GRID, only, simulated, with_power, with_views

from lorries import lorry
from sarsplat import ScatteringLaw, simulate_raycast
from sarsplat.data import Dataset
from sarsplat.examination.contradictions import examine
from sarsplat.geometry import View

KINDS: dict[str, Callable[[float], View]] = {
    "tilted": lambda azimuth: View(azimuth, 30.0, 25.0),
    "left and tilted": lambda azimuth: View(azimuth, 30.0, -20.0, "left"),
}


@cache
def dataset(kind: str, ground: float | None = 0.05) -> Dataset:
    """A lorry from such views."""
    mesh, plain = lorry(), simulated(None)
    views = [KINDS[kind](view.azimuth_deg) for view in plain.views]
    how = {"law": ScatteringLaw(), "ground_gamma0": ground, "ray_spacing": 0.08}
    power = np.stack([simulate_raycast(mesh, view, GRID, **how) for view in views])
    return with_views(replace(plain, power=power, ground=ground is not None), views)


@pytest.mark.parametrize("ground", [None, 0.05])
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_right_passes(kind: str, ground: float | None) -> None:
    found = examine(dataset(kind, ground))
    assert found.contradictions == []
    assert "as given" in found.checks["azimuths"]
    assert found.checks["near range"].startswith("at the top")


@pytest.mark.parametrize("kind", KINDS)
def test_azimuths_in_the_other_sense_are_found_and_both_twins_are_right(kind: str) -> None:
    seen = dataset(kind)
    wrong = with_views(seen, [replace(view, azimuth_deg=-view.azimuth_deg) for view in seen.views])
    assert "flip the columns (power[:, :, ::-1]) and negate the tilts if azimuths do run clockwise" in only(wrong)
    # the second remedy shows a mirrored target
    flipped = with_power(wrong, wrong.power[:, :, ::-1])
    mended = with_views(flipped, [replace(view, tilt_deg=-view.tilt_deg) for view in wrong.views])
    assert examine(mended).contradictions == []
    mirror = np.diag([1.0, -1.0, 1.0])
    for right, twin in zip(seen.views, mended.views, strict=True):
        np.testing.assert_allclose(twin.look.gradients @ mirror, right.look.gradients * [[-1], [1]], atol=1e-9)


def test_turned_images_are_found() -> None:
    assert "near range is at the bottom" in only(with_power(dataset("tilted"), dataset("tilted").power[:, ::-1, ::-1]))


def test_shadows_beside_the_target_are_not_taken_for_a_turned_image() -> None:
    seen = dataset("tilted")
    examined = examine(with_views(seen, [View(one.azimuth_deg, 50.0, 75.0) for one in seen.views]))
    assert "the azimuth axes are tilted too much" in examined.checks["orientation"]
