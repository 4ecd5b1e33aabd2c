"""What views leave open: closed forms, and the cases that were reconstructed to find the thresholds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sarsplat.examination.plausible import weak_directions, weakest_direction
from sarsplat.geometry import View
from sarsplat.scenes import mstar_views, paper_views


def ring(count: int, *grazings: float) -> list[View]:
    return [View(360 * k / count, grazing) for k in range(count) for grazing in grazings]


def arc(width: float, *grazings: float) -> list[View]:
    return [View(azimuth, grazing) for azimuth in np.linspace(-width / 2, width / 2, 7) for grazing in grazings]


PAPER = [view for view, split in paper_views() if split == "train"]

SOUND = {"paper": PAPER, "8 at 45°": ring(8, 45), "4 at 3 grazing angles": ring(4, 15, 45, 75), "8 at 75°": ring(8, 75)}
UNCERTAIN = {
    "8 at 30°": ring(8, 30),
    "8 at 15°": ring(8, 15),
    "many at 15°": ring(36, 15),
    "mstar": [view for view, split in mstar_views() if split == "train"],
    "a quarter circle": arc(90, 45),
}
OPEN = {"left and right": ring(2, 45), "ten degrees": arc(10, 45), "a single view": [View(10, 30)]}


@pytest.mark.parametrize("name", SOUND)
def test_sound_views_pass_without_a_word(name: str) -> None:
    assert weak_directions(SOUND[name]) == []


@pytest.mark.parametrize("name", UNCERTAIN)
def test_views_that_leave_the_shape_uncertain_are_told_with_a_remedy(name: str) -> None:
    (told,) = weak_directions(UNCERTAIN[name])
    assert "times less well along directions" in told
    assert "add views at other grazing angles" in told
    assert not weakest_direction(UNCERTAIN[name]).undetermined


@pytest.mark.parametrize("name", OPEN)
def test_views_that_determine_no_shape_are_told(name: str) -> None:
    (told,) = weak_directions(OPEN[name])
    assert "do not determine positions along" in told
    assert weakest_direction(OPEN[name]).undetermined
    assert weakest_direction(OPEN[name]).conditioning > 10


def test_what_is_proposed_helps() -> None:
    low = ring(8, 15)
    (told,) = weak_directions(low)
    assert "such as 60°" in told
    assert weakest_direction([*low, *ring(8, 60)]).conditioning < weakest_direction(low).conditioning / 2


@pytest.mark.parametrize("grazing", [10.0, 20.0, 40.0])
def test_many_views_around_have_a_closed_form(grazing: float) -> None:
    """A side in front of the views at azimuth φ, seen with cos φ: ⟨cos²φ⟩ = 2/3, ⟨cos φ⟩ = π/4."""
    sin, cos = math.sin(math.radians(grazing)), math.cos(math.radians(grazing))
    open_ = [[sin**2 * 2 / 3, sin * cos * math.pi / 4], [sin * cos * math.pi / 4, cos**2]]  # outwards and upwards
    values, vectors = np.linalg.eigh(open_)
    found = weakest_direction(ring(360, grazing))
    assert found.conditioning == pytest.approx(1 / math.sqrt(1 - values[-1]), rel=1e-3)
    assert found.above_horizon_deg == pytest.approx(math.degrees(math.asin(abs(vectors[1, -1]))), abs=0.2)


def test_the_conditioning_depends_on_neither_the_zero_of_azimuth_nor_the_order() -> None:
    turned = [View(view.azimuth_deg + 35, view.grazing_deg) for view in reversed(PAPER)]
    assert weakest_direction(turned).conditioning == pytest.approx(weakest_direction(PAPER).conditioning)


def test_more_grazing_angles_determine_better() -> None:
    sets = [ring(8, 15), ring(8, 15, 30), ring(8, 15, 30, 60)]
    found = [weakest_direction(views).conditioning for views in sets]
    assert found == sorted(found, reverse=True)
