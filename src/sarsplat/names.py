"""Choices of command-line options, kept apart from their implementations so that `--help` imports little."""

from typing import Literal

from sarsplat.plugins import discover

TargetName = Literal[
    "t72", "btr70", "2s1", "kraz", "slicy", "building-a", "building-b", "building-c", "village", "satellite", "aircraft"
]  # fmt: skip
"""Built-in targets, the keys of `sarsplat.scenes.TARGETS`."""

SCATTERINGS = discover("sarsplat.gaussians", "law_", "LAW", "sarsplat.scattering")
"""Laws of scattering by their `kind`, imported at first use."""

Simulator = Literal["raycast", "splat"]

Swept = Literal["azimuth", "grazing"]
"""Angles that can change along a film strip."""

Quantity = Literal["amplitude", "power", "db", "complex"]
"""Quantities of pixels in measured images."""

Transmit = Literal["each", "one"]
"""Transmitters of a stack: each pass, or one for all."""

CrossPolarised = Literal["mean", "both"]
"""Channels of HV and VH of one antenna: their mean, or both."""

Backscatter = Literal["beta0", "sigma0", "gamma0"]
"""Reference areas of power: slant plane, ground, or ground projected towards the radar."""

Projection = Literal["level", "terrain"]
"""Surfaces that geocoded images were projected onto."""

RadarSide = Literal["right", "left"]

Side = Literal["top", "right", "bottom", "left"]
"""Sides of an image, in order of the counter-clockwise quarter turns that bring each to the top."""

Speckle = Literal["response", "white", "none"]
"""Models of speckle: correlated by the radar's response, uncorrelated, or none."""

ChipQuantity = Literal["magnitude", "power", "complex"]
"""Quantities of pixels in generated chips."""

ChipScale = Literal["max", "fixed", "calibrated"]
"""Scales of generated chips: white is the maximum of each, or that of all training images; or no scale."""

ChipFormat = Literal["jpeg", "png", "npy"]
"""File formats of generated chips."""

MstarSplit = Literal["soc", "eoc-depression", "eoc-configuration", "eoc-version"]
"""Standard splits of MSTAR chips into training and test sets of classifiers."""

SampleKind = Literal["real", "synthetic"]
"""Kinds of images in the SAMPLE set: measured or simulated."""

Map = Literal["dsm", "gamma0", "layover-shadow"]
"""Maps of a run: surface heights, surface γ⁰, or layover and shadow of a view."""

Content = Literal["gaussians", "points", "mesh", "dsm", "gamma0", "layover-shadow"]
"""Results of a run that can be exported."""

Colour = Literal["db", "height"]
"""Colours of Gaussians: γ⁰ in decibels, in grey, or the height, from blue (low) to yellow (high)."""
