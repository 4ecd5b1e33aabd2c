"""`sarsplat import sicd`: complex images with their geometry in, a dataset out."""

from pathlib import Path

from sarsplat.cli.from_signature import comma_separated, command_of
from sarsplat.cli.importers import Contents, Recognised, first_described

_ENDINGS = (".nitf", ".ntf", ".sicd")
_NAMES = {"start": "date", "polarization": "polarisation"}  # names of facts for users

command = command_of(
    __name__,
    "sarsplat.importers.sicd:import_sicd",
    around=comma_separated("LAT,LON[,HAE]", (2, 3), "47.3769,8.5417"),
    pixel=comma_separated("ROW,COL", (2,), "1200,800"),
)


def recognise(contents: Contents) -> Recognised | None:
    """Recognise NITF files; of several, the first that can be read is described."""
    from sarsplat.importers.sarkit_xml import is_nitf

    if contents.path.is_file() and (is_nitf(contents.path) or contents.path.suffix.lower() in _ENDINGS):
        return _described(contents.path)  # or say what else it is
    files = contents.ending_in(*_ENDINGS) if contents.path.is_dir() else []
    return (first_described(files, _described) or _described(files[0])) if files else None


def _described(path: Path) -> Recognised:
    from sarsplat.importers.sicd_file import read_sicd
    from sarsplat.importers.sicd_geometry import layout_around, said_of_place, spot_of_pixel

    sicd = read_sicd(path)
    rows, columns = sicd.axes
    (height, width), middle = sicd.shape, (sicd.shape[0] // 2, sicd.shape[1] // 2)
    spot = spot_of_pixel(sicd, middle, heading_deg=0.0)
    layout = layout_around(sicd, spot, rows.spacing_m)
    facts = {
        "version": sicd.version,
        **{_NAMES.get(name, name): text for name, text in sicd.collection.items()},
        "where": f"{spot.latitude_deg:.6f}°, {spot.longitude_deg:.6f}°, {spot.height_m:.1f} m above the ellipsoid "
        f"(its middle, pixel {middle[0]},{middle[1]})",
        "radar": f"looks {layout.look}, {layout.distance_m / 1e3:.4g} km away at the compass bearing "
        f"{layout.view.azimuth_deg:.1f}°",
        "grazing": f"{layout.view.grazing_deg:.2f}°, slant plane tilted by {layout.tilt_deg:z.1f}°",
        "size": f"{height} rows × {width} columns, {height * rows.spacing_m:.4g} m × {width * columns.spacing_m:.4g} m",
        "spacing": f"{rows.spacing_m:.4g} m × {columns.spacing_m:.4g} m",
        "resolution": f"{rows.resolution_m:.4g} m × {columns.resolution_m:.4g} m (3 dB)",
        "pixels": f"{sicd.pixel_type}, grid {sicd.projection.Grid_Type}",
        "power": f"β⁰ ({', '.join(sicd.calibration)})" if sicd.calibration else "β⁰ up to one factor",
    }
    if (astray := said_of_place(sicd)) is not None:
        facts["beware"] = astray
    return Recognised("a SICD (complex SAR image)", facts)
