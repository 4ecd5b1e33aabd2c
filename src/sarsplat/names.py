"""Names that command-line options accept, without importing what they name, which is too slow for `--help`."""

from __future__ import annotations

from typing import Literal

from sarsplat.plugins import discover

TargetName = Literal[
    "t72", "btr70", "2s1", "kraz", "slicy", "building-a", "building-b", "building-c", "village", "satellite", "aircraft"
]  # fmt: skip
"""Built-in targets; a test compares them with `sarsplat.scenes.TARGETS`."""

SCATTERINGS = discover("sarsplat.gaussians", "law_", "LAW", "sarsplat.scattering")
"""Laws of scattering by their `kind`; each is imported when it is asked for."""

Simulator = Literal["raycast", "splat"]
"""What makes simulated images."""

Swept = Literal["azimuth", "grazing"]
"""The angle that changes along a film strip."""

Quantity = Literal["amplitude", "power", "db", "complex"]
"""What the numbers of an image mean."""

Transmit = Literal["each", "one"]
"""Whether each pass of a stack transmits itself, or one transmits for all."""

CrossPolarised = Literal["mean", "both"]
"""Whether HV and VH of one antenna become one channel, or stay two."""

Backscatter = Literal["beta0", "sigma0", "gamma0"]
"""What the power of an image is per unit of: of slant plane, ground, or ground seen from the radar."""

Projection = Literal["level", "terrain"]
"""What the producer of geocoded pictures took for the ground."""

RadarSide = Literal["right", "left"]
"""Sides of its flight to which a radar looks."""

Side = Literal["top", "right", "bottom", "left"]
"""Sides of a picture, by the number of counter-clockwise quarter turns that bring each to the top."""

Speckle = Literal["response", "white", "none"]
"""How speckle is correlated: through the radar's response, or not at all; or there is none."""

ChipQuantity = Literal["magnitude", "power", "complex"]
"""What pixels of generated chips mean."""

ChipScale = Literal["max", "fixed", "calibrated"]
"""What of generated chips is white: the brightest of each, that of all training images, or nothing."""

ChipFormat = Literal["jpeg", "png", "npy"]
"""Files of generated chips."""

MstarSplit = Literal["soc", "eoc-depression", "eoc-configuration", "eoc-version"]
"""Standard splits of MSTAR's chips into those that train and those that test a recogniser."""

SampleKind = Literal["real", "synthetic"]
"""Measured or simulated images of the SAMPLE set."""

Map = Literal["dsm", "gamma0", "layover-shadow"]
"""What a map of a run shows: heights of the surface, its brightness, or layover and shadow of a view."""

Content = Literal["gaussians", "points", "mesh", "dsm", "gamma0", "layover-shadow"]
"""Which result of a run a file contains."""

Colour = Literal["db", "height"]
"""What the colours of Gaussians show: γ⁰ in decibels, in grey, or the height, from blue (low) to yellow (high)."""
