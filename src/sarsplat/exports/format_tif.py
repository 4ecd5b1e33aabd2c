"""`.tif`: a map of the surface from above, for a GIS: heights, brightness, or layover and shadow."""

from __future__ import annotations

from pathlib import Path

from sarsplat.data.geotiff import LEVELS, Raster, write_raster
from sarsplat.exports.format import Format
from sarsplat.radar.layover_shadow import BOTH, FREE, LAYOVER, LEGEND, SHADOW, UNKNOWN

_COLOURS = {
    FREE: (245, 245, 240),
    SHADOW: (40, 50, 90),
    LAYOVER: (230, 120, 30),
    BOTH: (130, 40, 110),
    UNKNOWN: (200, 200, 200),
}
_CLASSES = "; ".join(f"{value} {what}" for value, what in LEGEND.items())


def _write_heights(raster: Raster, path: Path) -> None:
    above = raster.height_above
    level = "z of the scene" if above is None else f"above {LEVELS[above]}"
    write_raster(path, raster, f"height of the surface, {level}, m", unit="m")


FORMAT = Format(
    writers={
        "dsm": lambda raster, path, _: _write_heights(raster, path),
        "gamma0": lambda raster, path, _: write_raster(path, raster, "gamma0 of the surface, linear"),
        "layover-shadow": lambda raster, path, _: write_raster(path, raster, _CLASSES, colours=_COLOURS),
    },
    opened_with={name: "QGIS, GDAL or rasterio" for name in ("dsm", "gamma0", "layover-shadow")},
    recognises=lambda head, _: head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),
    coordinates="map",
    named_by_content=True,
)
