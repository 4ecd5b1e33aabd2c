"""Groups the rows of a table into stacks: passes of one view, or polarisations."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.geometry import Stack
from sarsplat.importers.measured_image import MeasuredImage
from sarsplat.importers.table import ListedPicture, PictureTable

_NO_RADIANS = {"deg", "degree", "degrees", "m", "metre", "metres", "meter", "meters"}
"""Last words of a column's name that say that it holds no b/R."""

_SHARED = {
    "view": "angles",
    "spacing_m": "pixel spacing",
    "resolution_m": "resolution",
    "azimuth_std_deg": "standard deviation of the azimuth",
    "split": "sets",
}
"""What all channels of a view must have in common."""


@dataclass(frozen=True)
class Recording:
    """How all channels were recorded."""

    wavelength_m: float
    """λ, m."""
    transmit: str = "each"
    """Whether each pass transmits and receives itself ("each"), or one transmits for all ("one")."""
    noise: float | None = None
    """Power of the noise in each channel, in the unit of the squared amplitudes."""
    conjugate: bool = False
    """Whether what is farther away has more phase: exp(+jkR)."""
    flattened: bool = False
    """Whether the phases of the level plane z = 0 were taken out (`Stack.plane_phases`); they are put back."""


def lists_stacks(listed: PictureTable) -> bool:
    """Whether a table has columns of channels, and several rows for a view."""
    views = [picture.view for picture in listed.pictures if picture.view is not None]
    return bool(listed.columns.keys() & {"baseline", "polarisation"}) and len(set(views)) < len(views)


def stacks_of(listed: PictureTable, images: Sequence[MeasuredImage], recording: Recording) -> list[MeasuredImage]:
    """The stack of each view, in the order of the table, given the image of each row.

    Rows have `view`, and `baseline` (b/R, rad; 0 where no column says it) or `polarisation`. Refused if columns are
    missing, images have no phase, channels of a view differ in more than their phases, or they are no valid `Stack`.
    """
    _check_columns(listed)
    channels: dict[str, list[tuple[ListedPicture, MeasuredImage]]] = {}
    for row, image in zip(listed.pictures, images, strict=True):
        if row.view is None:
            raise SarsplatError(f"{listed.path} does not say which view {row.name} belongs to; name it in every row")
        if row.baseline_rad is None and "baseline" in listed.columns:
            raise SarsplatError(f"{listed.path} does not say what the baseline of {row.name} is; give b/R, rad")
        if image.pixels.dtype.kind != "c":
            raise SarsplatError(f"{row.name} holds power, but a stack needs phases; give complex files")
        if not image.pixels.any():
            raise SarsplatError(f"{row.name} is zero everywhere, which no channel of a stack is; leave out its row")
        channels.setdefault(row.view, []).append((row, image))
    return [_stack(f"{listed.path}: the view {shown(name)}", name, own, recording) for name, own in channels.items()]


def _check_columns(listed: PictureTable) -> None:
    columns = listed.columns
    if "view" not in columns:
        raise SarsplatError(
            f"{listed.path} has no column that says which rows are channels of one view; name it with --columns "
            "view=NAME, or leave out --wavelength"
        )
    if not columns.keys() & {"baseline", "polarisation"}:
        raise SarsplatError(
            f"{listed.path} has no column of baselines (b/R, rad) or of polarisations; name it with --columns "
            "baseline=NAME or polarisation=NAME, or leave out --wavelength"
        )
    unit = re.findall(r"[a-z]+", columns.get("baseline", "").lower())[-1:]
    if set(unit) & _NO_RADIANS:
        raise SarsplatError(
            f"the column {shown(columns['baseline'])} of {listed.path} seems to hold {unit[0]}; give perpendicular "
            "baselines over the range, b/R, in radians, and call it baseline"
        )


def _stack(
    where: str, name: str, channels: Sequence[tuple[ListedPicture, MeasuredImage]], recording: Recording
) -> MeasuredImage:
    """One view; `where` is how an error begins."""
    rows, images = zip(*channels, strict=True)
    first = images[0]
    if len(images) == 1:
        raise SarsplatError(f"{where} has one row; a stack needs several, so add its others, or remove it")
    for image in images[1:]:
        for attribute, words in _SHARED.items():
            if (own := getattr(image, attribute)) != (expected := getattr(first, attribute)):
                remedy = "give them the same" if attribute == "split" else "coregister them, and give them the same"
                raise SarsplatError(
                    f"{where} has channels of different {words}, {shown(expected)} in {first.name} and {shown(own)} in "
                    f"{image.name}; {remedy}"
                )
        if image.pixels.shape != first.pixels.shape:
            sizes = (" × ".join(map(str, one.pixels.shape)) for one in (first, image))
            raise SarsplatError(
                f"{where} has channels of different sizes, {next(sizes)} pixels in {first.name} and {next(sizes)} in "
                f"{image.name}; coregister them to the same pixels"
            )
    try:
        stack = Stack(
            recording.wavelength_m,
            tuple(row.baseline_rad or 0.0 for row in rows),
            recording.transmit,
            None if recording.noise is None else (recording.noise,) * len(rows),
            _polarisations(rows),
        )
    except SarsplatError as error:
        raise SarsplatError(f"{where}: {error}") from error
    signal = np.stack([image.pixels for image in images])
    if recording.conjugate:
        signal = signal.conj()
    if recording.flattened:
        signal = (signal * np.exp(1j * stack.plane_phases(first.view, first.grid))).astype(signal.dtype)
    return replace(first, name=name, pixels=signal, stack=stack)


def _polarisations(rows: Sequence[ListedPicture]) -> tuple[str, ...] | None:
    """Of each channel; None if no row says it."""
    named = [row.polarisation for row in rows]
    if not any(named):
        return None
    if missing := [row.name for row in rows if not row.polarisation]:
        raise SarsplatError(
            f"{counted(len(missing), 'row')} of {len(rows)} have no polarisation, the first that of {missing[0]}; fill "
            "the column, or leave it empty in all"
        )
    return tuple(str(name) for name in named)
