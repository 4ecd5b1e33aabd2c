"""Import stacks: complex pictures of a folder, grouped by their table into passes or polarisations of each view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from sarsplat.arguments import checks_arguments
from sarsplat.data.dataset import Dataset
from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry import Stack
from sarsplat.importers.about import AboutPictures
from sarsplat.importers.listed_images import assumptions_of_table, in_range, read_pictures, write_pictures
from sarsplat.importers.measured_image import MeasuredImage
from sarsplat.importers.table import ListedPicture, PictureTable, read_picture_table
from sarsplat.names import Backscatter, Transmit

_SHARED = {
    "view": "angles",
    "spacing_m": "pixel spacing",
    "resolution_m": "resolution",
    "azimuth_std_deg": "standard deviation of the azimuth",
    "split": "sets",
    "pixels.shape": "sizes",
}
"""Attributes that all channels of a view have in common, in words."""

Channel = tuple[ListedPicture, MeasuredImage]


@checks_arguments
def import_stack(
    folder: str | Path,
    out: str | Path,
    *,
    wavelength_m: float,
    transmit: Transmit = "each",
    noise: float | None = None,
    conjugate: bool = False,
    flattened: bool = False,
    scale: float | None = None,
    backscatter: Backscatter = "beta0",
    overwrite: bool = False,
    **about: Unpack[AboutPictures],
) -> Dataset:
    """Import stacks of complex pictures (TIFF, NPY, MATLAB) with a table (CSV) of passes or polarisations.

    Rows with the same view are its channels, coregistered: passes, with b/R in radians in the column baseline, or
    polarisations, received and transmitted, in the column polarisation.

    Parameters
    ----------
    folder : Path
        Folder of the pictures.
    out : Path
        Dataset folder to write.
    wavelength_m : float
        Wavelength, m.
    transmit : {"each", "one"}
        Each pass transmits itself, or one transmits for all.
    noise : float, optional
        Power of each channel's noise, in the unit of the images; learned unless given.
    conjugate : bool
        The phase rises with distance.
    flattened : bool
        Phases of the level plane z = 0 were taken out. Unless they were, a scatterer at the scene's origin must have
        the same phase in every pass.
    scale : float, optional
        Factor on the pixels: 1, or the file's own.
    backscatter : {"beta0", "sigma0", "gamma0"}
        Normalisation of the power: σ⁰ and γ⁰ become β⁰ by the factor of level ground.
    overwrite : bool
        Replace an existing dataset.
    **about
        Table, lengths, angles, orientation, looks, ground, terrain and the target's box: see `AboutPictures`.

    Raises
    ------
    SarsplatError
        As `import_folder` does, or if channels do not make a stack.

    Warns
    -----
    SarsplatWarning
        As `import_folder` does.
    """
    folder = Path(folder)
    listed = read_picture_table(folder, about)
    pictures, assumptions = read_pictures(listed, about, "complex", scale, None, backscatter)
    images, layout = in_range(listed, pictures, about, assumptions)
    images = [
        _stack(listed, view, channels, wavelength_m, transmit, noise, conjugate, flattened)
        for view, channels in _channels(listed, images).items()
    ]
    source: dict[str, Any] = {
        "quantity": "complex",
        "scale": scale,
        "offset": None,
        **layout,
        "assumptions": [
            *assumptions,
            *assumptions_of_table(listed, about, backscatter),
            f"what is farther away has {'more' if conjugate else 'less'} phase in the files",
            "the phases of the level plane z = 0 were taken out of the files"
            if flattened
            else "no phases were taken out of the files, and the scene's origin has the same in every pass",
        ],
    }
    return write_pictures(out, folder, listed, images, about, source, kind="stack", overwrite=overwrite)


def _channels(listed: PictureTable, images: Sequence[MeasuredImage]) -> dict[str, list[Channel]]:
    """Group the images of the table's rows by view."""
    if "view" not in listed.columns or not listed.columns.keys() & {"baseline", "polarisation"}:
        raise SarsplatError(
            f"{listed.path} lacks a column of views, or one of baselines (b/R, rad) or polarisations; name them, as by "
            "`columns={'view': 'NAME', 'baseline': 'NAME'}`, or import single images with `sarsplat import folder`"
        )
    channels: dict[str, list[Channel]] = {}
    for row, image in zip(listed.pictures, images, strict=True):
        if row.view is None:
            listed.refuse_unstated("view", row)
        if row.baseline_rad is None and "baseline" in listed.columns:
            listed.refuse_unstated("baseline, b/R in radians,", row)
        if not image.pixels.any():
            raise SarsplatError(f"{row.name} is zero everywhere, which no channel of a stack is; leave out its row")
        channels.setdefault(row.view, []).append((row, image))
    return channels


def _stack(
    listed: PictureTable,
    name: str,
    channels: Sequence[Channel],
    wavelength_m: float,
    transmit: Transmit,
    noise: float | None,
    conjugate: bool,
    flattened: bool,
) -> MeasuredImage:
    """Stack the channels of one view; raise if they are not those of one `Stack`."""
    where = f"{listed.path}: the view {shown(name)}"
    rows, images = zip(*channels, strict=True)
    first = images[0]
    if len(images) == 1:
        raise SarsplatError(f"{where} has one row; a stack needs several, so add its others, or remove it")
    for image in images[1:]:
        for attribute, words in _SHARED.items():
            own, expected = (attrgetter(attribute)(one) for one in (image, first))
            if own != expected:
                raise SarsplatError(
                    f"{where} has channels of different {words}, {shown(expected)} in {first.name} and {shown(own)} in "
                    f"{image.name}; coregister them, and give them the same"
                )
    try:
        offsets = tuple(row.baseline_rad or 0.0 for row in rows)
        noises = None if noise is None else (noise,) * len(rows)
        stack = Stack(wavelength_m, offsets, transmit, noises, _polarisations(listed, rows))
    except SarsplatError as error:
        raise SarsplatError(f"{where}: {error}") from error
    signal = np.stack([image.pixels for image in images])
    if conjugate:
        signal = signal.conj()
    if flattened:
        signal = (signal * np.exp(1j * stack.plane_phases(first.view, first.grid))).astype(signal.dtype)
    return replace(first, name=name, pixels=signal, stack=stack)


def _polarisations(listed: PictureTable, rows: Sequence[ListedPicture]) -> tuple[str, ...] | None:
    """Return the polarisation of each channel; None if no row states it."""
    if not any(row.polarisation for row in rows):
        return None
    for row in rows:
        if not row.polarisation:
            listed.refuse_unstated("polarisation", row)
    return tuple(str(row.polarisation) for row in rows)
