"""From where `sarsplat simulate` looks: the protocol's views, a raster of angles, or random directions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sarsplat.cli.arguments import Angles, views_from
from sarsplat.errors import SarsplatError

if TYPE_CHECKING:
    from sarsplat.geometry import View


Raster = tuple[Angles, Angles, Angles]
"""What was given of a raster of views: azimuths, grazing angles, and incidence angles instead of these."""


def simulated_views(
    theirs: list[tuple[View, str]], train: Raster, random: int | None, seed: int, test: Raster, test_theirs: bool
) -> list[tuple[View, str]]:
    """Views with their splits: `theirs`, the protocol's, where nothing else is given.

    `random` training views lie between the lowest and the highest grazing angle; with `test_theirs` the test views are
    the protocol's, whatever the training views are.
    """
    if random is not None:
        own = _random(theirs, train, random, seed)
    elif any(train):
        own = views_from(*train)
    elif any(test):
        raise SarsplatError(
            "test views were given, but the protocol sets both training and test views; give --azimuth as well"
        )
    else:
        return theirs
    tested = _test(theirs, train, test, test_theirs)
    seen = {_towards(view) for view in own}
    unseen = [(view, split) for view, split in tested if _towards(view) not in seen]
    if tested and not unseen:
        raise SarsplatError(f"all {len(tested)} test views are also training views; choose others with --test-azimuth")
    return [*((view, "train") for view in own), *unseen]


def _towards(view: View) -> tuple[float, ...]:
    """The same for −30° and 330°."""
    return tuple(view.direction.round(9).tolist())


def _random(theirs: list[tuple[View, str]], given: Raster, count: int, seed: int) -> list[View]:
    from sarsplat.scenes.protocols import random_views

    azimuth, grazing, incidence = given
    if azimuth:
        raise SarsplatError("--random-views draws the azimuths, but --azimuth was given; leave out one of them")
    if grazing or incidence:
        limits = views_from(("0",), grazing, incidence)
    else:
        limits = [view for view, split in theirs if split == "train"]
    grazings = [view.grazing_deg for view in limits]
    return random_views(count, min(grazings), max(grazings), seed)


def _test(theirs: list[tuple[View, str]], train: Raster, given: Raster, test_theirs: bool) -> list[tuple[View, str]]:
    if test_theirs:
        if any(given):
            raise SarsplatError("both --test-protocol and test angles were given; give only one of them")
        return [(view, split) for view, split in theirs if split != "train"]
    if not any(given):
        return []
    azimuth, grazing, incidence = given
    if not grazing and not incidence:
        _, grazing, incidence = train
    return [(view, "test") for view in views_from(azimuth or train[0], grazing, incidence, prefix="test-")]
