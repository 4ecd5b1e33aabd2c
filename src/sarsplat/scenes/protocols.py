"""Views and grids of the experiments."""

import math

from sarsplat.arguments import check_number
from sarsplat.geometry import ImageGrid, View
from sarsplat.scenes.scattering import generator

_MAX_VIEWS = 10_000


def paper_views() -> list[tuple[View, str]]:
    """Return the views of the paper's rendered sets with their sets: 24 'train' and 48 'test'.

    Incidence 15, 45 and 75°; training azimuths 0, 45, …, 315°, test azimuths the other 16 of the 15° raster.
    Source: SAR-GS, Tables I–III. The paper also prints "every third of 24", which would overlap.
    """
    return [
        (View(float(azimuth), 90.0 - incidence), "train" if azimuth % 45 == 0 else "test")
        for incidence in (15.0, 45.0, 75.0)
        for azimuth in range(0, 360, 15)
    ]


def paper_grid() -> ImageGrid:
    """Return 128 × 128 pixels, spacing and resolution 0.3 m."""
    return ImageGrid(128, 128, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))


def mstar_views() -> list[tuple[View, str]]:
    """Return views like those of measured MSTAR sets: 36 training azimuths at 17° grazing, test azimuths in between.

    Sets: 'train' (0, 10, …, 350° at 17°), 'test-17' and 'test-15' (5, 15, …, 355° at 17° and at 15°).
    """
    return [
        (View(float(azimuth), grazing), split)
        for split, first, grazing in (("train", 0, 17.0), ("test-17", 5, 17.0), ("test-15", 5, 15.0))
        for azimuth in range(first, 360, 10)
    ]


def random_views(count: int, lowest_deg: float, highest_deg: float, seed: int) -> list[View]:
    """Draw 1 to 10,000 directions, uniform over the part of the sky between two grazing angles, degrees."""
    check_number("`random_views`", count, 1, _MAX_VIEWS)
    low, high = (math.sin(math.radians(angle)) for angle in (lowest_deg, highest_deg))
    azimuths, heights = generator(seed, "views").random((2, count))
    return [
        View(round(360 * azimuth, 3), round(math.degrees(math.asin(low + (high - low) * height)), 3))
        for azimuth, height in zip(azimuths, heights)
    ]


def mstar_grid() -> ImageGrid:
    """Return 128 × 128 pixels with the spacing and the true 3 dB widths of the public MSTAR chips."""
    return ImageGrid(128, 128, spacing_m=(0.203125, 0.202148), resolution_m=(0.3229, 0.3013))
