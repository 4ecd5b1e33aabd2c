"""The grid of a rendering whose pixels differ from those of the run."""

from __future__ import annotations

from dataclasses import replace

from sarsplat.geometry import ImageGrid


def asked_grid(
    own: ImageGrid, pixels: tuple[int, int] | None, spacing_m: float | None, resolution_m: float | None
) -> ImageGrid:
    """A run's grid with another size (rows, columns), spacing or resolution (m), the same in azimuth and slant range.

    Without a size, as many pixels as cover the area of the run's images.
    """
    spacing = own.spacing_m if spacing_m is None else (spacing_m, spacing_m)
    resolution = own.resolution_m if resolution_m is None else (resolution_m, resolution_m)
    changed = replace(own, spacing_m=spacing, resolution_m=resolution)
    if pixels is None:
        pixels = (
            max(1, round(own.rows * own.spacing_m[1] / changed.spacing_m[1])),
            max(1, round(own.columns * own.spacing_m[0] / changed.spacing_m[0])),
        )
    return replace(changed, rows=pixels[0], columns=pixels[1])
