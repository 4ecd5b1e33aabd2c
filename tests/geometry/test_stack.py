"""Stacks: what their channels may be, and how far they resolve elevations."""

import math

import pytest

from sarsplat import Stack


def test_evenly_spaced_passes_repeat_after_as_many_resolutions_as_there_are_gaps() -> None:
    stack = Stack(0.03, tuple(0.001 * k for k in range(8)))
    assert stack.resolution_m == pytest.approx(0.03 / (2 * 0.007))
    assert stack.ambiguous_elevation_m == pytest.approx(7 * stack.resolution_m, rel=0.01)
    assert Stack(0.03, stack.offsets_rad, transmit="one").resolution_m == pytest.approx(2 * stack.resolution_m)


def test_uneven_passes_repeat_later() -> None:
    """A ruler of marks 0, 1, 4, 9, 11 measures each length once: phases are alike after all eleven."""
    ruler = Stack(0.03, tuple(0.007 / 11 * mark for mark in (0, 1, 4, 9, 11)))
    assert ruler.ambiguous_elevation_m == pytest.approx(11 * ruler.resolution_m, rel=0.01)


def test_one_pass_resolves_nothing() -> None:
    alone = Stack(0.03, (0.0,))
    assert alone.resolution_m == alone.ambiguous_elevation_m == math.inf
    assert not alone.interferometric


def test_polarisations_tell_no_elevation() -> None:
    assert not Stack(0.03, (0.0, 0.0), polarisations=("HH", "VV")).interferometric
    assert not Stack(0.03, (0.0, 0.0, 0.001), polarisations=("HH", "VV", "HH")).interferometric
    assert Stack(0.03, (0.0, 0.001), polarisations=("HH", "HH")).interferometric
