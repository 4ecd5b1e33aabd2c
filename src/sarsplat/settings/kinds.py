"""Kinds of numbers in settings, with their ranges."""

from typing import Annotated

from msgspec import Meta

Count = Annotated[int, Meta(ge=1, le=100_000_000)]
Iteration = Annotated[int, Meta(ge=0, le=100_000_000)]
Degree = Annotated[int, Meta(ge=0, le=3)]
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
LEAST = 1e-6
"""Minimum of positive numbers: squares and reciprocals of smaller ones would leave float32."""

Positive = Annotated[float, Meta(ge=LEAST, le=1e6)]
NotNegative = Annotated[float, Meta(ge=0, le=1e6)]
OpticalDepth = Annotated[float, Meta(ge=1e-3, le=40)]
"""Two-way peak optical depth, up to `sarsplat.gaussians.MAX_OPTICAL_DEPTH`."""

RaysPerPixel = Annotated[float, Meta(ge=0.01, le=1000)]
Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
Share = Annotated[float, Meta(ge=0, le=1)]
