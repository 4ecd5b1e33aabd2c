"""Pictures of a table, with the views and lengths that their rows, their files and the user state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from jaxtyping import Shaped

from sarsplat.data.dataset import Dataset
from sarsplat.data.geotiff import Georeference
from sarsplat.data.orientation import SIDES, Layout, oriented
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.geometry import Place, View
from sarsplat.importers.about import AboutImages, AboutPictures, Pair
from sarsplat.importers.columns import FACTORS, told_of_factor
from sarsplat.importers.files import warn_caller
from sarsplat.importers.images import assume, dataset_of, with_unplaced, write_imported
from sarsplat.importers.measured_image import MeasuredImage, view_of
from sarsplat.importers.pictures import Values, read_values
from sarsplat.importers.table import ListedPicture, PictureTable
from sarsplat.names import Backscatter, Quantity, Side
from sarsplat.radiometry import beta0_of_gamma0, beta0_of_sigma0

_AGREE_DEG = 5.0  # maximum difference between an azimuth and that of its heading: norths of maps, small squints
_MIN_GRAZING_DEG = 1.0  # minimum grazing angle in the calculation of a squint
_SAME = 0.01  # relative difference of lengths that are rounded

StatedPair = tuple[float | None, float | None]


@dataclass(frozen=True)
class Picture:
    """Picture with its row of the table, its values and its view."""

    row: ListedPicture
    """Row, completed by what the user states of all pictures."""
    values: Values
    view: View
    slant: float
    """Length in the slant plane of a stated metre in range."""

    @property
    def resolved(self) -> bool:
        """True if the resolution is stated."""
        return any(self.row.resolution_m)

    def lengths(self, listed: PictureTable, name: str, stated: StatedPair, slant: float) -> Pair:
        """Return spacing or resolution (azimuth, range), m; a stated metre in range is `slant` metres long."""
        azimuth, slant_range = stated
        if azimuth is None or slant_range is None:
            listed.refuse_unstated(
                name, self.row, f"give `{name}_m`, or name its column: `columns={{'{name}': 'NAME'}}`"
            )
        return azimuth, slant_range * slant


def read_pictures(
    listed: PictureTable,
    about: AboutPictures,
    quantity: Quantity | None,
    scale: float | None,
    offset: float | None,
    backscatter: Backscatter,
) -> tuple[list[Picture], list[str]]:
    """Read the pictures of a table as β⁰, and return them with the assumptions made."""
    pictures: list[Picture] = []
    for listed_row in listed.pictures:
        row = _completed(listed_row, about)
        given = (scale if row.scale is None else row.scale), (offset if row.offset is None else row.offset)
        if row.power_factor is not None and given != (None, None):
            raise SarsplatError(f"{listed.path} has a column of factors; leave out `scale` and `offset`, or the column")
        own = row.power_factor is None and given == (None, None)
        found = pictures[-1].values.quantity if pictures else quantity
        values = read_values(row.path, found, _either(given[0], 1.0), _either(given[1], 0.0), listed.real, own)
        _require_unit(listed, values.quantity)
        mirrored = about.get("mirrored", False) if row.looks_left is None else row.looks_left
        view = _view(listed, row, about, mirrored)
        factor, stated = values.power_factor, values.tags.backscatter or backscatter
        if stated != backscatter != "beta0":
            raise SarsplatError(f"{row.path} says that it holds {stated}; leave out `backscatter`")
        if row.power_factor is not None:
            factor = row.power_factor
        values = replace(values, image=_beta0(values.image, view, stated, factor))
        slant = view.look.slant_range(1.0) if about.get("ground_range") else 1.0
        pictures.append(Picture(row, values, view, slant))
    columns = ", ".join(f"{meaning} = {name}" for meaning, name in listed.columns.items())
    told = [f"columns of the table: {columns}"]
    stating = [one.row.name for one in pictures if one.values.power_factor != 1]
    silent = [one.row for one in pictures if not one.values.tags.factors and one.row.scale is None]
    if stating and silent:
        remedy = f"the file does not either, but that of {stating[0]} does: fill in a factor for each, or give `scale`"
        listed.refuse_unstated("factor", silent[0], remedy)
    factors = FACTORS.keys() & listed.columns.keys() if pictures[-1].row.power_factor is not None else ()
    told += [told_of_factor(meaning, listed.columns[meaning]) for meaning in factors]
    told += [f"the numbers are {pictures[-1].values.quantity}"] if quantity is None else []
    told += dict.fromkeys(text for picture in pictures for text in picture.values.assumptions)
    if unknown := sum(int(picture.values.unknown.sum()) for picture in pictures):
        assume(told, f"{counted(unknown, 'pixel')} hold what their files call no data, and are taken for zero")
    return pictures, told


def assumptions_of_table(listed: PictureTable, about: AboutPictures, backscatter: Backscatter) -> list[str]:
    """Return sentences on the angles, the unit of the power and the resolution."""
    told = []
    if "heading" in listed.columns and "azimuth" not in listed.columns:
        told.append("azimuths are 90° to the left of headings, or to the right where the radar looks left")
    told.append(
        f"azimuths are directions to the radar, {'counter-' if about.get('counter_clockwise') else ''}clockwise; 0 is "
        f"{about.get('azimuth_offset_deg') or 0.0:g}° from the target's nose"
    )
    if backscatter != "beta0":
        told.append(f"the power is {backscatter}, and became β⁰ as on level ground")
    if about.get("resolution_m") is None and not any("resolution" in meaning for meaning in listed.columns):
        told.append("the resolution is the pixel spacing")
    return told


def in_range(
    listed: PictureTable, pictures: Sequence[Picture], about: AboutPictures, told: list[str]
) -> tuple[list[MeasuredImage], dict[str, Any]]:
    """Turn pictures in range and azimuth near side up; also return their layout, for remedies, if all have the same.

    The assumed orientation is added to `told`.
    """
    mirrored = about.get("mirrored", False)
    sides = [_near(listed, picture.row, about.get("near")) for picture in pictures]
    images = [_in_range(listed, picture, side, mirrored) for picture, side in zip(pictures, sides, strict=True)]
    _warn_of_world_files(pictures)
    common = len(set(sides)) == 1
    at = sides[0] if common else "side that the table says"
    told.append(f"the radar is at the {at} of the pictures, which are {'' if mirrored else 'not '}mirrored")
    looks = {bool(picture.row.looks_left) for picture in pictures}
    if not common or len(looks) > 1:
        return images, {}
    layout = Layout(sides[0], mirrored, about.get("counter_clockwise", False), looks.pop())
    return images, {"layout": asdict(layout)}


def write_pictures(
    out: str | Path,
    folder: Path,
    listed: PictureTable,
    images: Sequence[MeasuredImage],
    about: AboutPictures,
    source: dict[str, Any],
    *,
    kind: Literal["folder", "stack"],
    place: Place | None = None,
    overwrite: bool,
) -> Dataset:
    """Write images of a folder as a dataset; `source` holds the importer's own facts."""
    target, known = about.get("target"), AboutImages.__annotations__.keys()
    dataset = dataset_of(
        images,
        target=(listed.target or folder.resolve().name) if target is None else target,
        source={
            "kind": kind,
            "table": listed.path.name,
            "columns": listed.columns,
            "ground_range": about.get("ground_range", False),
            **source,
        },
        train_views=about.get("train_views"),
        calibration=about.get("calibration", "relative"),
        place=place,
        **cast(AboutImages, {name: value for name, value in about.items() if name in known}),
    )
    other = "train" if dataset.splits() == ("train",) else "test"
    dataset, pictures = with_unplaced(dataset, [replace(one, split=one.split or other) for one in images])
    return write_imported(out, dataset, overwrite=overwrite, pictures=pictures)


def _require_unit(listed: PictureTable, quantity: Quantity) -> None:
    """Raise if the quantity of pictures is not that of the table's column of scales."""
    for meaning, (_, quantities) in FACTORS.items():
        if meaning in listed.columns and "scale" not in listed.columns and quantity not in quantities:
            raise SarsplatError(
                f"{listed.path} scales pictures by {shown(listed.columns[meaning])}, which is for "
                f"{' or '.join(quantities)}, but they are taken for {quantity}; give `quantity={quantities[0]!r}`, or "
                f"name it as a factor on the numbers: `columns={{'scale': '{listed.columns[meaning]}'}}`"
            )


def _either(own: float | None, common: float) -> float:
    return common if own is None else own


def _completed(row: ListedPicture, about: AboutPictures) -> ListedPicture:
    """Return the row with the user's statements of all pictures where its cells are empty."""

    def filled(own: StatedPair, common: Pair | None) -> StatedPair:
        azimuth, slant = (b if a is None else a for a, b in zip(own, common or (None, None), strict=True))
        return azimuth, slant

    look = about.get("look")
    return replace(
        row,
        looks_left=look == "left" if look and row.looks_left is None else row.looks_left,
        spacing_m=filled(row.spacing_m, about.get("spacing_m")),
        resolution_m=filled(row.resolution_m, about.get("resolution_m")),
        azimuth_std_deg=_either(row.azimuth_std_deg, about.get("azimuth_std_deg") or 0.0),
    )


def _beta0(
    image: Shaped[np.ndarray, "rows columns"], view: View, backscatter: Backscatter, factor: float
) -> Shaped[np.ndarray, "rows columns"]:
    """Return power, or complex amplitude, times a factor on the power, as that of β⁰."""
    if backscatter != "beta0":
        factor = {"sigma0": beta0_of_sigma0, "gamma0": beta0_of_gamma0}[backscatter](factor, view.grazing_deg)
    if factor == 1:
        return image
    beta0: Shaped[np.ndarray, "rows columns"] = image * image.real.dtype.type(
        math.sqrt(factor) if image.dtype.kind == "c" else factor
    )
    return beta0


def _near(listed: PictureTable, row: ListedPicture, near: Side | None) -> Side:
    """Return the near side of a picture; raise if table and user state different ones."""
    if near is not None and row.near not in (None, near):
        raise SarsplatError(
            f"{listed.path}: near range of {row.name} is at the {row.near} ({listed.columns['near-side']}), but `near` "
            f"is {near}; leave it out, or mend the table"
        )
    return row.near or near or "top"


def _in_range(listed: PictureTable, picture: Picture, near: Side, mirrored: bool) -> MeasuredImage:
    """Return a picture in range and azimuth, near side up."""
    row, georeference = picture.row, picture.values.tags.georeference
    stated = row.spacing_m
    if georeference is not None:
        if georeference.crs is not None:
            raise SarsplatError(
                f"{row.path} is geocoded ({georeference.system}), not in range and azimuth; `import folder` resamples "
                "single images, by `geocoded='level'` or `geocoded='terrain'`; remove GeoTIFF tags that are wrong"
            )
        stated = spacing_of_tags(str(row.path), georeference, near, stated)
    spacing = picture.lengths(listed, "spacing", stated, picture.slant)
    resolution = picture.lengths(listed, "resolution", row.resolution_m, picture.slant) if picture.resolved else spacing
    return MeasuredImage(
        row.name,
        oriented(picture.values.image, near, mirrored != bool(row.looks_left)),
        picture.view,
        spacing,
        resolution,
        azimuth_std_deg=row.azimuth_std_deg or 0.0,
        split=row.split,
    )


def _warn_of_world_files(pictures: Sequence[Picture]) -> None:
    """Warn once if a picture without georeference has a world file (a.tfw or a.wld of a.tif), so may be geocoded."""
    for path in (picture.row.path for picture in pictures if picture.values.tags.georeference is None):
        ending = path.suffix
        for own in (f"{ending[:2]}{ending[-1]}w", f"{ending}w", ".wld"):
            if path.with_suffix(own).is_file():
                warn_caller(
                    f"{path.name} has the world file {path.stem}{own} beside it, by which it is a map; if it is, "
                    "make a GeoTIFF of it, as by gdal_translate -a_srs EPSG:NUMBER, and import that with `geocoded`"
                )
                return


def spacing_of_tags(name: str, georeference: Georeference, near: Side, stated: StatedPair) -> StatedPair:
    """Return the spacing (azimuth, range), m, as stated, or else of a picture's tags; raise if they differ."""
    columns, rows = georeference.pitch
    pitch = (columns, rows) if SIDES.index(near) % 2 == 0 else (rows, columns)
    check_spacing(name, pitch, stated, "azimuth × range")
    azimuth, slant_range = (_either(given, own) for own, given in zip(pitch, stated, strict=True))
    return azimuth, slant_range


def check_spacing(name: str, pitch: Pair, stated: StatedPair, axes: str) -> None:
    """Raise if the stated spacing differs from that of the picture's tags."""
    if any(given is not None and abs(given / own - 1) > _SAME for own, given in zip(pitch, stated, strict=True)):
        given = " × ".join("–" if length is None else f"{length:.5g}" for length in stated)
        raise SarsplatError(
            f"{name} says that its pixels are {pitch[0]:.5g} m × {pitch[1]:.5g} m ({axes}), but {given} is given; "
            "leave out the spacing, or correct one of them"
        )


def _view(listed: PictureTable, row: ListedPicture, about: AboutPictures, left: bool) -> View:
    """Return the view of a picture; that of a radar looking `left` is of its mirror image, as if it looked right."""
    tilt = row.tilt_deg or 0.0
    grazing = about.get("grazing_deg") if row.grazing_deg is None else row.grazing_deg
    if grazing is None:
        remedy = "name the column with `columns={'grazing': 'NAME'}` (or incidence), or give `grazing_deg` for all"
        listed.refuse_unstated("grazing angle", row, remedy)
    offset = about.get("azimuth_offset_deg") or 0.0
    unknown = row.azimuth_std_deg == math.inf
    azimuth = 0.0 if unknown else offset + _azimuth(listed, row, about.get("counter_clockwise", False))
    return view_of(f"{listed.path}: {row.name}", azimuth, grazing, -tilt if left else tilt)


def _azimuth(listed: PictureTable, row: ListedPicture, counter_clockwise: bool) -> float:
    """Return the direction to the radar, degrees clockwise from the table's azimuth 0, of an azimuth or a heading."""
    heading = row.heading_deg
    across = None if heading is None or row.looks_left is None else heading + (90 if row.looks_left else -90)
    if row.azimuth_deg is not None:
        azimuth = -row.azimuth_deg if counter_clockwise else row.azimuth_deg
        if across is not None:
            _require_heading(listed, row, azimuth, across)
        return azimuth
    column = shown(listed.columns["heading"])
    if across is None:
        raise SarsplatError(
            f"{listed.path} has headings ({column}) but does not say to which side {row.name} looks; give it as `look` "
            "or a column look (right or left), or name azimuths with `columns={'azimuth': 'NAME'}`"
        )
    if counter_clockwise:
        raise SarsplatError(
            f"{listed.path} has headings ({column}), which run clockwise; leave out `counter_clockwise`, or name a "
            "column of azimuths with `columns={'azimuth': 'NAME'}`"
        )
    return across


def _require_heading(listed: PictureTable, row: ListedPicture, azimuth: float, across: float) -> None:
    """Raise if a row's azimuth contradicts the direction `across` its heading, but for the squint of its tilt.

    Above level flight, an azimuth axis tilted by τ is squinted by atan(tan τ / sin θ).
    """
    grazing = math.radians(min(max(row.grazing_deg or 0.0, _MIN_GRAZING_DEG), 90.0))
    squint = math.degrees(math.atan(math.tan(math.radians(row.tilt_deg or 0.0)) / math.sin(grazing)))
    if abs((azimuth - across + 180) % 360 - 180) > _AGREE_DEG + abs(squint):
        side = "left" if row.looks_left else "right"
        raise SarsplatError(
            f"{listed.path}: {row.name} has an azimuth of {row.azimuth_deg:g}°, but a radar with the heading "
            f"{row.heading_deg:g}° that looks to its {side} is in the direction {across % 360:g}°; say which holds "
            "with `columns={'azimuth': 'NAME'}` or `columns={'heading': 'NAME'}`, or mend the table"
        )
