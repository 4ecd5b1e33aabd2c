"""Import the public SAMPLE set of AFRL: measured MSTAR chips and simulated images of the same vehicles, complex.

Written from the set's public description of file names (such as
`t72_real_A_elevDeg_016_azCenter_041_77_serial_812.mat`) and variables, which omits the orientation. Measured images are
MSTAR's chips, so their orientation is assumed (see `importers.mstar`): near range is the bottom row, and the nose turns
clockwise with growing azimuth, unless `near` and `mirrored` say otherwise.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Unpack

import numpy as np

from sarsplat.arguments import checks_arguments
from sarsplat.data.dataset import Dataset
from sarsplat.data.orientation import oriented
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.geometry.responses import GAUSSIAN, TAYLOR, stated_taylor
from sarsplat.importers.about import AboutScene
from sarsplat.importers.files import files_in, raise_damaged, warn_caller
from sarsplat.importers.images import dataset_of, write_imported
from sarsplat.importers.mat import read_mat
from sarsplat.importers.measured_image import MeasuredImage, view_of
from sarsplat.importers.pictures import power_or_signal
from sarsplat.names import SampleKind, Side

_NAME = re.compile(
    r"(?P<target>[A-Za-z0-9]+)_(?P<kind>real|synth)_.*elevDeg_(?P<elevation>\d{3})_azCenter_(?P<azimuth>\d{3})_.*\.mat"
)
_MOST_OFF_DEG = 1.0  # maximum difference of an angle from that of the name, which has whole degrees


@dataclass(frozen=True)
class SampleName:
    """Facts in the name of a file."""

    path: Path
    target: str
    kind: SampleKind
    azimuth_deg: int
    elevation_deg: int


@checks_arguments
def import_sample(
    folder: str | Path,
    out: str | Path,
    *,
    target: str,
    kind: SampleKind = "real",
    train_views: int | None = None,
    near: Literal["top", "bottom"] = "bottom",
    mirrored: bool = False,
    overwrite: bool = False,
    **about: Unpack[AboutScene],
) -> Dataset:
    """Import images of AFRL's SAMPLE set: measured MSTAR chips and simulated ones (.mat), complex.

    Parameters
    ----------
    folder : Path
        Folder of the set, its `mat_files`, or any folder below; MATLAB files with other names are left out.
    out : Path
        Dataset folder to write.
    target : str
        Vehicle, e.g. t72; the set has 2s1, bmp2, btr70, m1, m2, m35, m548, m60, t72 and zsu23.
    kind : {"real", "synthetic"}
        Measured or simulated images.
    train_views : int, optional
        Number of training images, evenly chosen; the others are test images. Without it, all are for training.
    near : {"top", "bottom"}
        Rows that are near the radar; MSTAR's chips have them at the bottom.
    mirrored : bool
        Treat the images as mirror images, with azimuths that grow clockwise.
    overwrite : bool
        Replace an existing dataset.
    **about
        Terrain and the target's box: see `AboutScene`.

    Returns
    -------
    Dataset
        Complex, of relative calibration, single look, with ground.

    Raises
    ------
    SarsplatError
        If there are no such images, one is damaged, or its angles are not those of its name.
    """
    folder = Path(folder)
    chosen = _chosen(folder, target, kind)
    read = [_read(named, folder, near, mirrored) for named in chosen]
    images = [image for image, _ in read]
    facts = read[0][1]
    source: dict[str, Any] = {
        "kind": "sample",
        "images": kind,
        **facts,
        "near": near,
        "mirrored": mirrored,
        "assumptions": [
            f"near range is the {near} row, and the images are {'' if mirrored else 'not '}mirrored, "
            "which the set's description does not say",
            f"azimuth = {'+' if mirrored else '−'}azimuth of the file; 0 is the nose towards the radar, as in MSTAR",
            *[f"the Taylor window has n̄ = {TAYLOR.sidelobes}"] * (images[0].response != GAUSSIAN),
        ],
    }
    dataset = dataset_of(images, target=chosen[0].target, source=source, train_views=train_views, **about)
    return write_imported(out, dataset, overwrite=overwrite)


def _chosen(folder: Path, target: str, kind: SampleKind) -> list[SampleName]:
    files = [path for path in files_in(folder, "the SAMPLE set") if path.suffix == ".mat"]
    named = [name for name in map(named_as_sample, files) if name is not None]
    if not named:
        raise SarsplatError(f"{folder} has no file named like those of the SAMPLE set; give its folder mat_files")
    if other := len(files) - len(named):
        warn_caller(
            f"{counted(other, 'MATLAB file')} in {folder} with names unlike those of the SAMPLE set are left out"
        )
    chosen = [one for one in named if one.target.lower() == target.lower() and one.kind == kind]
    if not chosen:
        others = sorted({f"{one.target} ({one.kind})" for one in named})
        raise SarsplatError(f"{folder} has no {kind} images of {shown(target)}; it has {', '.join(others)[:500]}")
    return chosen


def named_as_sample(path: Path) -> SampleName | None:
    """Parse the name of a file; None if the set has no such names."""
    parts = _NAME.fullmatch(path.name)
    if parts is None:
        return None
    kind: SampleKind = "real" if parts["kind"] == "real" else "synthetic"
    return SampleName(path, parts["target"], kind, int(parts["azimuth"]), int(parts["elevation"]))


def _read(named: SampleName, folder: Path, near: Side, mirrored: bool) -> tuple[MeasuredImage, dict[str, Any]]:
    """Read an image, and facts for the dataset's source."""
    variables = read_mat(named.path)
    pixels = variables.get("complex_img")
    if not isinstance(pixels, np.ndarray) or pixels.ndim != 2 or pixels.dtype.kind != "c":
        raise SarsplatError(f"{named.path} has no complex matrix complex_img; give files of the SAMPLE set")
    signal = power_or_signal(pixels, "complex", str(named.path))
    azimuth = _angle(named, variables, "azimuth", named.azimuth_deg)
    elevation = _angle(named, variables, "elevation", named.elevation_deg)
    image = MeasuredImage(
        str(named.path.relative_to(folder)),
        oriented(signal, near, mirrored),
        view_of(str(named.path), azimuth if mirrored else -azimuth, elevation),
        _lengths(named, variables, "pixel_spacing"),
        _lengths(named, variables, "resolution"),
        response=stated_taylor(_number(variables, "taylor_weights")),
    )
    facts = {name: _number(variables, name) for name in ("center_freq", "bandwidth", "taylor_weights")}
    return image, {name: value for name, value in facts.items() if value is not None}


def _angle(named: SampleName, variables: Mapping[str, Any], name: str, whole_deg: int) -> float:
    """Read an angle, degrees; the whole degrees of the file's name decide between radians and degrees."""
    value = _number(variables, name)
    for degrees in () if value is None else (value, math.degrees(value)):
        if abs((degrees - whole_deg + 180) % 360 - 180) <= _MOST_OFF_DEG:
            return degrees
    raise_damaged(named.path, f"has {shown(value)} as {name}, but {whole_deg}° in its name")


def _lengths(named: SampleName, variables: Mapping[str, Any], name: str) -> tuple[float, float]:
    """Read azimuth and range, m; one that is 0, as where MSTAR's header lacks it, is taken for the other."""
    both = [_number(variables, f"{axis}_{name}") or 0.0 for axis in ("xrange", "range")]
    azimuth, slant_range = (own if own > 0 else max(both) for own in both)
    if azimuth <= 0:
        raise_damaged(named.path, f"has no {name.replace('_', ' ')} in xrange_{name} and range_{name}, m")
    return azimuth, slant_range


def _number(variables: Mapping[str, Any], name: str) -> float | None:
    """Return a finite scalar variable; None for any other."""
    value = variables.get(name)
    if not isinstance(value, np.ndarray) or value.size != 1 or value.dtype.kind not in "iuf":
        return None
    number = float(value.item())
    return number if math.isfinite(number) else None
