"""The renderer's numerical constants (docs/concepts/image-model.md §3), one place for every engine."""

CELL_WIDENING = 1.0 / 12.0
"""c: a ray's cell widens a footprint by c·δ² per axis (variance of a uniform cell)."""

MIN_RAY_DEPTH = 1e-3
"""A Gaussian touches a ray where its two-way optical depth τ is at least this."""

MIN_TRANSMITTANCE = 1e-4
"""A ray stops once its transmittance has fallen below this (the crossing Gaussian is kept)."""

IMAGE_CUT = 16.0
"""A Gaussian touches pixels within this squared Mahalanobis distance; its mass is renormalised by 1 − e⁻⁸."""
