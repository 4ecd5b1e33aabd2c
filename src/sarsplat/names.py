"""Names that options take, each list written once: what they name is too slow to import for the help of a command."""

from __future__ import annotations

from typing import Literal

TargetName = Literal["t72", "btr70", "2s1", "kraz", "slicy", "building-a", "building-b", "building-c"]
"""Built-in targets; a test compares them with `sarsplat.scenes.TARGETS`."""

Simulator = Literal["raycast", "splat"]
"""What makes simulated images."""

Swept = Literal["azimuth", "grazing"]
"""The angle that changes along a film strip."""

Quantity = Literal["amplitude", "power", "db", "complex"]
"""What the numbers of an image stand for."""

Side = Literal["top", "right", "bottom", "left"]
"""Of a picture, in the order of the quarter turns, counter-clockwise, that bring each to the top."""

SampleKind = Literal["real", "synthetic"]
"""Measured or simulated images of the SAMPLE set."""

Content = Literal["gaussians", "points", "mesh"]
"""What of a run a file may hold."""

Colour = Literal["db", "height"]
"""What colours of Gaussians show: γ⁰ in decibels, in grey, or the height, from blue (low) to yellow (high)."""
