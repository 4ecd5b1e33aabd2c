"""Names that options accept, each list written once: importing what they name is too slow for a command's help."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

TargetName = Literal["t72", "btr70", "2s1", "kraz", "slicy", "building-a", "building-b", "building-c"]
"""Built-in targets; a test compares them with `sarsplat.scenes.TARGETS`."""

SCATTERING_LAWS = {
    "harmonics": "sarsplat.gaussians.scattering:Harmonics",
    "normal-lobes": "sarsplat.gaussians.scattering:NormalLobes",
}
"""Module and class of each law of scattering, by its `kind`; `sarsplat.gaussians.SCATTERINGS` are the classes."""

if TYPE_CHECKING:
    ScatteringName = str
else:
    ScatteringName = Literal[tuple(SCATTERING_LAWS)]

Simulator = Literal["raycast", "splat"]
"""What makes simulated images."""

Swept = Literal["azimuth", "grazing"]
"""The angle that changes along a film strip."""

Quantity = Literal["amplitude", "power", "db", "complex"]
"""What the numbers of an image mean."""

Side = Literal["top", "right", "bottom", "left"]
"""Sides of a picture, by the number of counter-clockwise quarter turns that bring each to the top."""

SampleKind = Literal["real", "synthetic"]
"""Measured or simulated images of the SAMPLE set."""

Content = Literal["gaussians", "points", "mesh"]
"""Which result of a run a file contains."""

Colour = Literal["db", "height"]
"""What the colours of Gaussians show: γ⁰ in decibels, in grey, or the height, from blue (low) to yellow (high)."""
