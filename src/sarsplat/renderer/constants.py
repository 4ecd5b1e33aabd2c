"""Numerical constants of the renderer, for every engine (docs/concepts/image-model.md §3)."""

CELL_WIDENING = 1.0 / 12.0
"""Constant c: a ray's cell widens a footprint by c·δ² per axis (variance of a uniform cell)."""

MIN_RAY_DEPTH = 1e-3
"""Minimum two-way optical depth τ at which a Gaussian touches a ray."""

MIN_TRANSMITTANCE = 1e-4
"""Transmittance below which a ray stops (the crossing Gaussian is kept)."""

IMAGE_CUT = 16.0
"""Maximum squared Mahalanobis distance of pixels that a Gaussian touches; its mass is renormalised by 1 − e⁻⁸."""
