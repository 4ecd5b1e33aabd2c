"""Import measured MSTAR chips: choose training views, orient arrays, raise insignificant power.

Geometry. The published array has the radar at the bottom; turned by 180° it is our `image[range, azimuth]`, row 0 near.
TargetAz is 0 with the nose toward the radar, and with growing TargetAz the nose turns clockwise in the displayed chip,
which in our frame (azimuth clockwise from the nose) means φ = −TargetAz.

Whether the published chips are mirror images is not settled. `mirrored=True` assumes they are: the columns are flipped
and φ = +TargetAz. The two readings give each other's mirror image (y → −y) as the target and explain the chips equally
well, so no likelihood can tell them apart; only something known to be on one side of the vehicle can.

Power. The chips carry no absolute calibration here. Power is magnitude² over its mean over all pixels of the training
chips: β⁰ up to one common factor. Of JPEGs, the magnitude is max(DN, 2) / `dn_per_magnitude`, a column of the table of
labels; without it all JPEGs are taken to have the same scale. Phoenix magnitudes are not quantised, but some are zero:
their power is at least 0.001 (−30 dB) of its mean. Their phases are kept: the images are complex.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Unpack

import numpy as np
from jaxtyping import Num

from sarsplat.arguments import checks_arguments
from sarsplat.data.coverage import nearest_to
from sarsplat.data.dataset import Dataset
from sarsplat.data.orientation import oriented
from sarsplat.data.sidecar import UNPLACED
from sarsplat.errors import SarsplatError, counted
from sarsplat.importers.about import AboutScene
from sarsplat.importers.files import warn_caller
from sarsplat.importers.images import dataset_of, with_unplaced, write_imported
from sarsplat.importers.measured_image import MeasuredImage, view_of
from sarsplat.importers.mstar_chips import Chip, plain_name, read_chips
from sarsplat.importers.mstar_splits import SPLITS, Counts, divide
from sarsplat.names import MstarSplit

MIN_DN = 2.0
"""Minimum to which digital numbers are raised: below it is only quantisation, and zero has no logarithm."""
MIN_POWER = 1e-3
"""Minimum to which unquantised power is raised, relative to its mean: darker than any shadow, but not zero."""


@checks_arguments
def import_mstar(
    chips: str | Path,
    out: str | Path,
    *,
    labels: str | Path | None,
    target_class: str,
    train_views: int | Literal["all"],
    train_depression: int | Sequence[int] = 17,
    serial: str | None = None,
    split: MstarSplit | None = None,
    azimuth_std_deg: float = 0.0,
    mirrored: bool = False,
    test: bool = True,
    overwrite: bool = False,
    **about: Unpack[AboutScene],
) -> Dataset:
    """Import MSTAR chips: JPEGs with a table of labels, or original Phoenix files.

    Parameters
    ----------
    chips : Path
        Folder of the chips.
    out : Path
        Dataset folder to write.
    labels : Path or None
        Table (CSV) that labels JPEG chips (see `read_chips`); without it, Phoenix files are read.
    target_class : str
        Vehicle class, e.g. T72.
    train_views : int or "all"
        Number of training chips, the distinct ones nearest to azimuths k·360°/K, or all that there are at the training
        depressions; the others are test chips, one set per depression angle, such as test-17.
    train_depression : int or sequence of int
        Depression angles of the training chips, as planned, degrees; of several, each gets the next azimuth in turn.
    serial : str, optional
        Import only the vehicle with this serial number; without it, all of the class.
    split : {"soc", "eoc-depression", "eoc-configuration", "eoc-version"}, optional
        Take the chips of a standard split of MSTAR: standard operating conditions, or extended ones of another
        depression angle, of other configurations or of other versions. Training chips are those that train there, test
        chips those that test. Chips without azimuth are kept in the folder `unplaced`: they count for a recogniser, and
        `locate` finds their azimuths.
    azimuth_std_deg : float
        Standard deviation of the azimuths, degrees, of chips for which the table has none; uncertain ones are refined
        in training.
    mirrored : bool
        Treat the published chips as mirror images (see the head of this module).
    test : bool
        Import the other chips as test views; JPEGs of these are not read otherwise.
    overwrite : bool
        Replace an existing dataset.
    **about
        Terrain and the target's box: see `AboutScene`.

    Returns
    -------
    Dataset
        Of relative calibration, single look, with ground; power with mean 1 over the training views; complex if the
        chips are Phoenix files. Each image has the name of its chip; `source` lists assumptions.

    Raises
    ------
    SarsplatError
        If there are no such chips, too few of them, one is damaged, all training chips are black, or the output exists.

    Warns
    -----
    SarsplatWarning
        If chips lack labels or labels chips, the class holds several vehicles, chips of different sizes are cut, or
        the images contradict what is said of them, or look odd (`sarsplat.examine`).
    """
    depressions = [train_depression] if isinstance(train_depression, int) else list(train_depression)
    _check(train_views, depressions)  # before thousands of chips are read
    table = None if labels is None else Path(labels)
    testing, counts = list[Chip](), Counts()
    if split is None:
        training = _one_vehicle(read_chips(Path(chips), table, target_class), target_class, serial)
    else:
        names = SPLITS[split].names_of(target_class)
        training, testing, counts = divide(read_chips(Path(chips), table, names, unplaced=True), split, target_class)
        depressions = sorted({chip.depression for chip in training})
    placed = [chip for chip in training if chip.placed]
    if not placed:
        raise SarsplatError(f"no training chip of {target_class} has a target_az_deg in {labels}; fill some in")
    train = _training_chips(placed, train_views, depressions)
    every = [*training, *testing]
    several = split is not None and len({plain_name(chip.serial) for chip in every}) > 1
    trained = training if len(train) == len(placed) else []  # else no chip without azimuth is trained on, either
    unplaced = [("train", chip) for chip in trained if not chip.placed]
    unplaced += [(_test_set(chip, several), chip) for chip in every[len(trained) :] if not chip.placed]
    if not any(chip.magnitude.any() for chip in train):
        black = "the training chip is" if len(train) == 1 else f"all {len(train)} training chips are"
        raise SarsplatError(f"{black} black; choose others, or remove black ones from {chips}")
    chosen = {id(chip) for chip in train}
    others = [chip for chip in every if test and chip.placed and id(chip) not in chosen]
    others.sort(key=lambda chip: (-chip.depression, chip.target_az_deg, chip.name))
    ordered = [*train, *others]
    sets = [*["train"] * len(train), *(_test_set(chip, several) for chip in others), *(name for name, _ in unplaced)]
    every = [*ordered, *(replace(chip, target_az_deg=0.0, azimuth_std_deg=math.inf) for _, chip in unplaced)]
    sign = 1 if mirrored else -1
    images = [
        MeasuredImage(
            chip.name,
            oriented(pixels, chip.near, mirrored),
            view_of(chip.name, sign * chip.target_az_deg, chip.grazing_deg),
            chip.spacing_m,
            chip.resolution_m,
            response=chip.response,
            azimuth_std_deg=azimuth_std_deg if chip.azimuth_std_deg is None else chip.azimuth_std_deg,
            split=name,
        )
        for chip, pixels, name in zip(every, _pixels(every, len(train)), sets, strict=True)
    ]
    source: dict[str, Any] = {
        "kind": "mstar",
        "sensor": "X-band 9.6 GHz, HH, spotlight",
        "format": "phoenix" if labels is None else "jpeg",
        "serials": sorted({chip.serial for chip in ordered}),
        "train_views": len(train),
        "train_depression_deg": depressions,
        "mirrored": mirrored,
        **_calibration(ordered),
        "cut_to_common_size": len({image.pixels.shape for image in images if image.placed}) > 1,
        "chips": [{"name": chip.name, "target_az_deg": chip.target_az_deg, **_planned(chip)} for chip in ordered],
        "assumptions": _assumptions(ordered, images[: len(ordered)], mirrored),
    }
    if split is not None:
        source |= {"split": {"name": split, "parts": counts}}
    dataset = dataset_of(images, target=target_class, source=source, **about)
    dataset, pictures = with_unplaced(dataset, images)
    for listed, (_, chip) in zip(dataset.source.get(UNPLACED, ()), unplaced, strict=True):
        listed |= _planned(chip)
    return write_imported(out, dataset, overwrite=overwrite, pictures=pictures)


def _test_set(chip: Chip, several: bool) -> str:
    """Name the set of a test chip by depression angle, and by vehicle where a split has `several`."""
    name = f"test-{chip.depression}"
    return f"{name}-{plain_name(chip.serial) or 'unnamed'}" if several else name


def _planned(chip: Chip) -> dict[str, Any]:
    """Return vehicle and collection of a chip, which identify it."""
    return {"serial": chip.serial, "depression_deg": chip.depression}


def _one_vehicle(chips: list[Chip], target_class: str, serial: str | None) -> list[Chip]:
    serials = sorted({chip.serial for chip in chips})
    if serial is not None:
        chips = [chip for chip in chips if chip.serial == serial]
        if not chips:
            raise SarsplatError(f"there is no {target_class} of serial {serial!r}; choose one of {', '.join(serials)}")
    elif len(serials) > 1:
        warn_caller(
            f"the {target_class} chips show {len(serials)} vehicles (serials {', '.join(serials)}), treated as one; "
            "choose one serial to keep them apart"
        )
    return chips


def _check(train_views: int | Literal["all"], depressions: Sequence[int]) -> None:
    """Raise if no chips can satisfy these numbers."""
    number = train_views == "all" or (not isinstance(train_views, str) and train_views >= 1)
    if not number or not depressions or len(set(depressions)) < len(depressions):
        raise SarsplatError(
            f"`train_views` is {train_views!r} and `train_depression` {list(depressions)}; give a number from 1 or "
            "'all', and at least one angle, each once"
        )


def _training_chips(chips: list[Chip], count: int | Literal["all"], depressions: Sequence[int]) -> list[Chip]:
    """Choose the distinct chips nearest to k·360°/count, in the order of k, from the depressions in turn.

    "all" of them are in the order of their azimuths.
    """
    chosen: dict[int, Chip] = {}
    every: list[Chip] = []
    counts = sorted(Counter(chip.depression for chip in chips).items())
    for first, depression in enumerate(depressions):
        candidates = sorted((chip for chip in chips if chip.depression == depression), key=lambda chip: chip.name)
        if not candidates:
            raise SarsplatError(
                f"there are no chips at the training depression of {depression}°, but "
                f"{' and '.join(f'{number:,} at {angle}°' for angle, number in counts)}; choose among them by "
                "`train_depression`"
            )
        every += candidates
        if count == "all":
            continue
        numbers = range(first, int(count), len(depressions))
        if not 1 <= len(numbers) <= len(candidates):
            share = "" if len(depressions) == 1 else f"{len(numbers)} of "
            are, most = "is" if len(candidates) == 1 else "are", len(candidates) * len(depressions)
            enough = int(count) / (len(depressions) + 1)
            others = [str(deg) for deg, k in counts if deg not in depressions and min(k, len(candidates)) >= enough]
            also = f", or add {' or '.join(others)} to `train_depression`" * bool(others and numbers)
            raise SarsplatError(
                f"{share}{counted(int(count), 'training view')} asked for, but there {are} "
                f"{counted(len(candidates), 'chip')} at {depression}°; ask for {len(depressions)} to {most}{also}"
            )
        nearest = nearest_to([chip.target_az_deg for chip in candidates], [k * 360 / count for k in numbers])
        chosen |= {k: candidates[i] for k, i in zip(numbers, nearest, strict=True)}
    if count == "all":
        return sorted(every, key=lambda chip: (chip.target_az_deg, chip.name))
    return [chosen[k] for k in sorted(chosen)]


def _pixels(chips: list[Chip], training: int) -> list[Num[np.ndarray, "rows columns"]]:
    """Return the power of each chip, or its complex amplitude where the phase is known; the first are for training.

    If sizes differ, each side is made even, so that a common part lies on the pixels of all.
    """
    magnitudes = [np.maximum(chip.magnitude, np.float32(MIN_DN) * np.float32(chip.step)) for chip in chips]
    pixels = [magnitude**2 for magnitude in magnitudes]
    if phases := [chip.phase for chip in chips if chip.phase is not None]:
        mean = np.concatenate([power.ravel() for power in pixels[:training]]).mean(dtype=np.float64)
        least = np.sqrt(np.float32(MIN_POWER * mean))
        pixels = [
            np.maximum(magnitude, least) * np.exp(1j * phase)
            for magnitude, phase in zip(magnitudes, phases, strict=True)
        ]
    if len({image.shape for image in pixels}) > 1:
        pixels = [image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2] for image in pixels]
    return pixels


def _calibration(chips: list[Chip]) -> dict[str, Any]:
    """Describe the processing of `_pixels`."""
    mean = "mean_power, the mean over all pixels of the training chips"
    if chips[0].phase is not None:
        return {
            "calibration": f"none: power = magnitude^2 / {mean}; before, raised to min_power x its mean over these",
            "min_power": MIN_POWER,
        }
    if _scaled_alike(chips):
        power, scales = "max(DN, min_dn)^2", "all JPEGs taken as scaled alike"
    else:
        power, scales = "(max(DN, min_dn) / dn_per_magnitude)^2", "dn_per_magnitude from the table of labels"
    return {"calibration": f"none: power = {power} / {mean}; {scales}", "min_dn": MIN_DN}


def _assumptions(chips: list[Chip], images: list[MeasuredImage], mirrored: bool) -> list[str]:
    """Return sentences on facts that neither chips nor labels state."""
    sides = " or ".join(dict.fromkeys(chip.near for chip in chips))
    lengths = (f"{length:.4g}" for length in (*chips[0].spacing_m, *chips[0].resolution_m))
    assumed = [
        f"near range is at the {sides} of the chips, and they are {'' if mirrored else 'not '}mirror images",
        f"azimuth = {'+' if mirrored else '−'}TargetAz; the grazing angle is the measured depression",
    ]
    if chips[0].phase is None:
        assumed.append("pixels are {} m × {} m, the resolution is {} m × {} m (azimuth × range)".format(*lengths))
    if _scaled_alike(chips):
        assumed.append("all JPEGs are scaled alike")
    if not any(image.azimuth_std_deg for image in images):
        assumed.append("azimuths are exact")
    return assumed


def _scaled_alike(chips: list[Chip]) -> bool:
    return all(chip.step == 1 for chip in chips)
