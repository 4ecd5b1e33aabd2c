"""A producer of geocoded pictures that shares no code with the importer: GeoTIFFs, north up, from images of a radar.

For each place of the map it asks at which azimuth and slant range the radar sees the ground there, and takes the
image's value at these. Here east is +x and north +y, so a radar at the compass bearing β is at the azimuth β − 90°.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from made import write_geotiff
from sarsplat.geometry import ImageGrid, View

UTM_33N = (1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32633)
"""GeoTIFF keys; pixels are areas."""


def on_map(
    image: np.ndarray,
    view: View,
    grid: ImageGrid,
    side: int,
    pitch_m: float,
    height: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> np.ndarray:
    """An image (power) as `side`² pixels of the map around the origin; row 0 is the northernmost."""
    east, north = np.meshgrid(*2 * [(np.arange(side) - (side - 1) / 2) * pitch_m])
    north = -north
    phi, theta = np.radians(view.azimuth_deg), np.radians(view.grazing_deg)
    z = np.zeros_like(east) if height is None else height(east, north)
    to_radar = np.array([np.cos(phi) * np.cos(theta), -np.sin(phi) * np.cos(theta), np.sin(theta)])
    slant = -(to_radar[0] * east + to_radar[1] * north + to_radar[2] * z)
    azimuth = -np.sin(phi) * east - np.cos(phi) * north
    row = (slant - grid.center_m[1]) / grid.spacing_m[1] + (grid.rows - 1) / 2
    column = (azimuth - grid.center_m[0]) / grid.spacing_m[0] + (grid.columns - 1) / 2
    return np.maximum(map_coordinates(image.astype(float), [row, column], order=3, mode="nearest"), 0).astype(
        np.float32
    )


def write_map(path: Path, pixels: np.ndarray, pitch: float, keys=UTM_33N, corner=(5e5, 5e6), extra=()) -> Path:
    """A GeoTIFF whose top left corner lies there."""
    return write_geotiff(path, pixels, keys, (pitch, pitch, 0.0), extra, corner)


def write_maps(
    folder: Path,
    images: Sequence[np.ndarray],
    views: Sequence[View],
    grid: ImageGrid,
    side: int,
    pitch_m: float,
    **more,
) -> Path:
    """A folder of GeoTIFFs, each with the bearing of its radar and its incidence angle in the table.

    `height` is what the producer took for the ground; the map's unit is `unit_m` long.
    """
    folder.mkdir(exist_ok=True)
    height, unit_m = more.pop("height", None), more.pop("unit_m", 1.0)
    rows = ["file,azimuth,incidence"]
    for number, (image, view) in enumerate(zip(images, views, strict=True)):
        pixels = on_map(image, view, grid, side, pitch_m, height)
        write_map(folder / f"{number:03d}.tif", pixels, pitch_m / unit_m, **more)
        rows.append(f"{number:03d}.tif,{(view.azimuth_deg + 90) % 360},{view.incidence_deg}")
    (folder / "table.csv").write_text("\n".join(rows))
    return folder
