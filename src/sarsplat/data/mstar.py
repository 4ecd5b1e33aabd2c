"""Import measured MSTAR chips as a dataset: choose the training views, turn the arrays, set one common scale.

Geometry. The published array has the radar at the bottom; turned by 180° it is our `image[range, azimuth]`, row 0 near.
TargetAz is 0 with the nose toward the radar, and with growing TargetAz the nose turns clockwise in the displayed chip,
which in our frame (azimuth clockwise from the nose) means φ = −TargetAz.

Whether the published chips are mirror images is not settled. `mirrored=True` assumes they are: the columns are flipped
and φ = +TargetAz. The two readings give each other's mirror image (y → −y) as the target and explain the chips equally
well, so no likelihood can tell them apart; only something known to be on one side of the vehicle can.

Power. The chips carry no absolute calibration here. Power is magnitude² over its mean over all pixels of the training
chips: β⁰ up to one common factor. Of JPEGs, the magnitude is max(DN, 2) / `dn_per_magnitude`, a column of the table of
labels; without it all JPEGs are taken as scaled alike. Phoenix magnitudes are not quantised, but some are zero: their
power is at least 0.001 (−30 dB) of its mean. Their phases are kept: the images are complex.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Real

from sarsplat.data.dataset import Dataset, DatasetEntry
from sarsplat.data.dataset_folder import write_dataset
from sarsplat.data.evenly import nearest_to
from sarsplat.data.header import Box
from sarsplat.data.mstar_chips import Chip, read_chips
from sarsplat.data.plausible import suspicions, warn
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.geometry import ImageGrid, View

MIN_DN = 2.0
"""Digital numbers are raised to this: below it lies nothing but quantisation, and zero has no logarithm."""
MIN_POWER = 1e-3
"""Power that is not quantised is raised to this fraction of its mean: darker than any shadow, but not zero."""


def import_mstar(
    chips: str | Path,
    out: str | Path,
    *,
    labels: str | Path | None,
    target_class: str,
    train_views: int,
    train_depression: int | Sequence[int] = 17,
    serial: str | None = None,
    target_box_m: Box | None = None,
    azimuth_std_deg: float = 0.0,
    mirrored: bool = False,
    overwrite: bool = False,
) -> Dataset:
    """Make a dataset from measured chips of one vehicle.

    Parameters
    ----------
    chips : Path
        Folder of the chips: JPEGs that `labels` describes, or Phoenix files.
    out : Path
        Dataset to make.
    labels : Path or None
        Table of the JPEGs (see `read_chips`); None for Phoenix files.
    target_class : str
        E.g. `T72`.
    train_views : int
        Number K of training views: the distinct chips nearest to TargetAz = k·360°/K, k = 0 … K − 1. All others are
        test views, one set per depression: `test-17`, `test-15`.
    train_depression : int or sequence of int
        Depression, as planned, of the training views, degrees; of several, each gets the next of the K azimuths in
        turn.
    serial : str, optional
        Only this vehicle of the class; None takes them all.
    target_box_m : pair of (x, y, z), optional
        Corners of the box that contains the target, m, in the world frame: nose to +x. None: reconstructions derive it
        from the images.
    azimuth_std_deg : float
        Standard deviation of the azimuths, degrees, of chips for which the table has none.
    mirrored : bool
        Take the published chips for mirror images (see the head of this module).
    overwrite : bool
        Whether an existing dataset may be replaced.

    Returns
    -------
    Dataset
        Of relative calibration, single look, with ground; power with mean 1 over the training views; complex if the
        chips are Phoenix files. Each image bears
        the name of its chip; `source` says what was assumed.

    Raises
    ------
    SarsplatError
        If there are no such chips, too few of them, one is damaged, all training chips are black, or the output exists.

    Warns
    -----
    SarsplatWarning
        If chips lack labels or labels chips, the class holds several vehicles, chips of different sizes are cut, or
        the dataset looks odd (`sarsplat.data.plausible`).
    """
    found = read_chips(Path(chips), None if labels is None else Path(labels), target_class)
    found = _one_vehicle(found, target_class, serial)
    depressions = [train_depression] if isinstance(train_depression, int) else list(train_depression)
    train = _training_chips(found, train_views, depressions)
    chosen = {id(chip) for chip in train}
    test = [chip for chip in found if id(chip) not in chosen]
    test.sort(key=lambda chip: (-chip.depression, chip.target_az_deg, chip.name))
    ordered = [*train, *test]

    grid = _common_grid(ordered)
    magnitude = np.stack([_turned(_central(chip.magnitude, grid), mirrored) for chip in ordered])
    steps = np.array([chip.step for chip in ordered], np.float32)
    power = _power(magnitude, steps, len(train))
    scale = float(power[: len(train)].mean(dtype=np.float64))
    if not magnitude[: len(train)].any() or not np.float32(scale):  # or so faint that float32 has no such power
        raise SarsplatError(f"all {len(train)} training chips are black; remove them from {chips}")
    sign = 1 if mirrored else -1
    entries = tuple(
        DatasetEntry(
            _view(sign, chip),
            "train" if index < len(train) else f"test-{chip.depression}",
            chip.name,
            azimuth_std_deg if chip.azimuth_std_deg is None else chip.azimuth_std_deg,
        )
        for index, chip in enumerate(ordered)
    )
    source: dict[str, Any] = {
        "kind": "mstar",
        "sensor": "X-band 9.6 GHz, HH, spotlight",
        "format": "phoenix" if labels is None else "jpeg",
        "serials": sorted({chip.serial for chip in ordered}),
        "train_views": train_views,
        "train_depression_deg": depressions,
        "mirrored": mirrored,
        "azimuth": f"azimuth = {'+' if mirrored else '-'}TargetAz; grazing = measured depression",
        "orientation": f"published array turned by 180 degrees{', then columns flipped' if mirrored else ''}",
        **_calibration(steps),
        "mean_power": scale,
        "cut_to_common_size": any(chip.magnitude.shape != (grid.rows, grid.columns) for chip in ordered),
        "chips": [{"name": chip.name, "target_az_deg": chip.target_az_deg} for chip in ordered],
        "assumptions": _assumptions(ordered, entries, steps, mirrored),
    }
    relative, phases = np.ascontiguousarray(power / np.float32(scale)), _phases(ordered, grid, mirrored)
    dataset = (Dataset if phases is None else Dataset.of_complex)(
        grid,
        entries,
        relative if phases is None else np.sqrt(relative) * np.exp(1j * phases),
        target=target_class,
        calibration="relative",
        looks=1.0,
        ground=True,
        score_margin=round(3 / 16 * min(grid.rows, grid.columns)),
        target_box_m=target_box_m,
        source=source,
    )
    dataset = write_dataset(out, dataset, overwrite=overwrite)
    warn(suspicions(dataset))
    return dataset


def as_imported(
    published: Real[np.ndarray, "rows columns"], dataset: Dataset
) -> Real[np.ndarray, "imported_rows imported_columns"]:
    """What belongs to a chip, pixel by pixel as published, as its dataset has the chip; other datasets' as it is."""
    if dataset.source.get("kind") != "mstar":
        return published
    return _turned(_central(published, dataset.grid), dataset.source.get("mirrored") is True)


def _power(
    magnitude: Float32[np.ndarray, "chips rows columns"], steps: Float32[np.ndarray, " chips"], training: int
) -> Float32[np.ndarray, "chips rows columns"]:
    """Squares of magnitudes, the first of training chips, raised to the least that says anything."""
    power = np.maximum(magnitude, np.float32(MIN_DN) * steps[:, None, None]) ** 2
    if not steps.any():
        power = np.maximum(power, np.float32(MIN_POWER * power[:training].mean(dtype=np.float64)))
    return power


def _assumptions(
    chips: list[Chip], entries: tuple[DatasetEntry, ...], steps: Float32[np.ndarray, " chips"], mirrored: bool
) -> list[str]:
    """What neither chips nor labels say, in words."""
    first = chips[0]
    lengths = (f"{length:.4g}" for length in (*first.spacing_m, *first.resolution_m))
    found = [
        f"near range is the bottom row of the published chips, and they are {'' if mirrored else 'not '}mirror images",
        f"azimuth = {'+' if mirrored else '−'}TargetAz; the grazing angle is the measured depression",
    ]
    if steps.any():
        found.append("pixels are {} m × {} m, the resolution is {} m × {} m (azimuth × range)".format(*lengths))
    if (steps == 1).all():
        found.append("all JPEGs are scaled alike")
    if not any(entry.azimuth_std_deg for entry in entries):
        found.append("azimuths are exact")
    return found


def _phases(chips: list[Chip], grid: ImageGrid, mirrored: bool) -> Float32[np.ndarray, "chips rows columns"] | None:
    """As the chips are turned and cut; None if they have none."""
    known = [chip.phase for chip in chips if chip.phase is not None]
    return np.stack([_turned(_central(phase, grid), mirrored) for phase in known]) if known else None


def _calibration(steps: Float32[np.ndarray, " chips"]) -> dict[str, Any]:
    """What was done by `_power`, in words and numbers."""
    mean = "mean_power, the mean over all pixels of the training chips"
    if not steps.any():
        return {
            "calibration": f"none: power = magnitude^2 / {mean}; before, raised to min_power x its mean over these",
            "min_power": MIN_POWER,
        }
    if (steps == 1).all():
        power, chips = "max(DN, min_dn)^2", "all JPEGs taken as scaled alike"
    else:
        power, chips = "(max(DN, min_dn) / dn_per_magnitude)^2", "dn_per_magnitude from the table of labels"
    return {"calibration": f"none: power = {power} / {mean}; {chips}", "min_dn": MIN_DN}


def _turned(published: Real[np.ndarray, "rows columns"], mirrored: bool) -> Real[np.ndarray, "rows columns"]:
    """By 180°; mirroring undoes the flip of the columns."""
    return published[::-1] if mirrored else published[::-1, ::-1]


def _view(sign: int, chip: Chip) -> View:
    try:
        return View((sign * chip.target_az_deg) % 360, chip.grazing_deg)
    except SarsplatError as error:
        raise SarsplatError(f"{chip.name}: {error}") from error


def _one_vehicle(chips: list[Chip], target_class: str, serial: str | None) -> list[Chip]:
    serials = sorted({chip.serial for chip in chips})
    if serial is not None:
        chips = [chip for chip in chips if chip.serial == serial]
        if not chips:
            raise SarsplatError(
                f"there is no {target_class} with the serial {serial!r}; choose one of {', '.join(serials)}"
            )
    elif len(serials) > 1:
        warnings.warn(
            f"the {target_class} chips show {len(serials)} vehicles (serials {', '.join(serials)}), treated as one; "
            "choose one serial to keep them apart",
            SarsplatWarning,
            stacklevel=3,
        )
    return chips


def _training_chips(chips: list[Chip], count: int, depressions: Sequence[int]) -> list[Chip]:
    """The distinct chips nearest to k·360°/count, in the order of k; each k asks the next depression in turn."""
    if not depressions or len(set(depressions)) < len(depressions):
        raise SarsplatError(f"the training depressions {list(depressions)} must be at least one, each named once")
    chosen: dict[int, Chip] = {}
    for first, depression in enumerate(depressions):
        there = sorted((chip for chip in chips if chip.depression == depression), key=lambda chip: chip.name)
        numbers = range(first, count, len(depressions))
        if not there:
            known = ", ".join(f"{value}°" for value in sorted({chip.depression for chip in chips}))
            raise SarsplatError(
                f"there are no chips at the training depression of {depression}°; choose one of {known}"
            )
        if not 1 <= len(numbers) <= len(there):
            share = str(count) if len(depressions) == 1 else f"{len(numbers)} of {count}"
            raise SarsplatError(
                f"{share} training views were requested, but there are {len(there)} chips at {depression}°; "
                f"request between {len(depressions)} and {len(there) * len(depressions)} in all"
            )
        wanted = [k * 360 / count for k in numbers]
        nearest = nearest_to([chip.target_az_deg for chip in there], wanted)
        chosen |= {k: there[i] for k, i in zip(numbers, nearest, strict=True)}
    return [chosen[k] for k in sorted(chosen)]


def _common_grid(chips: list[Chip]) -> ImageGrid:
    """The grid of the chips; if their sizes differ, the smallest even size."""
    first = chips[0]
    for chip in chips:
        if not np.allclose([*chip.spacing_m, *chip.resolution_m], [*first.spacing_m, *first.resolution_m], rtol=1e-3):
            raise SarsplatError(
                f"{chip.name} has pixel spacing {chip.spacing_m} m and resolution {chip.resolution_m} m "
                f"but {first.name} has {first.spacing_m} and {first.resolution_m}; import chips of one kind"
            )
    shapes = {chip.magnitude.shape for chip in chips}
    rows, columns = first.magnitude.shape
    if len(shapes) > 1:
        rows = min(shape[0] for shape in shapes) // 2 * 2
        columns = min(shape[1] for shape in shapes) // 2 * 2
        warnings.warn(
            f"the chips have {len(shapes)} sizes; all are cropped around the centre to {rows} × {columns}",
            SarsplatWarning,
            stacklevel=3,
        )
    return ImageGrid(rows, columns, first.spacing_m, first.resolution_m, response=first.response)


def _central(
    image: Real[np.ndarray, "rows columns"], grid: ImageGrid
) -> Real[np.ndarray, "{grid.rows} {grid.columns}"]:
    top, left = (image.shape[0] - grid.rows) // 2, (image.shape[1] - grid.columns) // 2
    return image[top : top + grid.rows, left : left + grid.columns]
