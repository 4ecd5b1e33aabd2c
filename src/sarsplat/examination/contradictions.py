"""`examine`: check the images of a dataset against its metadata."""

from dataclasses import replace
from functools import partial

import numpy as np

from sarsplat.arguments import checks_arguments
from sarsplat.data import Dataset
from sarsplat.data.image import power_of
from sarsplat.data.orientation import SIDES, Layout, oriented
from sarsplat.errors import counted
from sarsplat.examination.orientation import Orientation, orientation, signs_of_map, turned_grid
from sarsplat.examination.outcome import Examination
from sarsplat.examination.plausible import suspicious_angles, suspicious_images
from sarsplat.examination.scaling import MUCH_CLIPPED, examine_cut_off, examine_scaling
from sarsplat.examination.single_values import examine_single_values
from sarsplat.examination.units import examine_units
from sarsplat.geometry import ImageGrid, View
from sarsplat.names import Side
from sarsplat.radiometry import bright_level

_MAX_IMAGES = 120  # maximum number of images that are examined; evenly chosen of more
_MAX_EMPTY = 1e-6  # edge power below which images show no ground, relative to their bright level

_SHADOW_DIRECTION = dict(zip(SIDES, ("downwards", "to the left", "upwards", "to the right"), strict=True))
"""Near side → direction in which shadows fall."""

_WAS_MAP = "cannot be determined from neighbours: resampled from a map, they match by whatever angles are given"

_AZIMUTH_REMEDY: dict[Side, str] = {
    "top": "check the table's azimuths",
    "right": "name the column of azimuths a heading (`columns={'heading': 'NAME'}` look='left'), or add 90° to them",
    "bottom": "add 180° to the table's azimuths, which must be bearings of the radar, not of its look",
    "left": "name the column of azimuths a heading (`columns={'heading': 'NAME'}` look='right'), or take 90° from them",
}
"""Near side → remedy for the azimuths of geocoded pictures."""

TWINS = (
    "Images with `mirrored` and azimuths in the other sense would match as well, as those of a mirrored target: "
    "which way the table counts azimuths decides."
)
"""Note on the table of orientations: a mirror cannot be distinguished from opposite azimuths."""

_TABLE = ("import with", "shadow beyond", "bright edge", "layover", "neighbours match", "")


@checks_arguments
def examine(dataset: Dataset) -> Examination:
    """Check whether the images of a dataset contradict its metadata.

    Parameters
    ----------
    dataset : Dataset
        At most 120 images, evenly chosen, are examined, of stacks their first channel; all images for duplicates,
        constant images and other units.

    Returns
    -------
    Examination
        Contradictions: angles in radians; constant or duplicate images; pixels and lines that are too bright for echoes
        or clipped; images of different scales; geocoded images; near range that is not row 0; azimuths in the opposite
        sense, or mirrored images; incidence for grazing angles; ground in images declared to have none; values that are
        not power; another number of looks; another resolution. Images do not determine the zero of the azimuth.
    """
    examined = Examination()
    columns = dataset.source.get("columns")
    by_incidence = isinstance(columns, dict) and "incidence" in columns and "grazing" not in columns
    angles = suspicious_angles(dataset.select("train").views, by_incidence)
    wrong = suspicious_images(dataset)
    examined.contradictions.extend(angles)
    differ = "the only one is not constant" if len(dataset) == 1 else f"all {len(dataset)} differ, none is constant"
    examined.conclude("images", wrong, differ)
    hot = examine_single_values(dataset, examined)
    cut_off = 0.0 if hot else examine_cut_off(dataset, examined)  # a line of hot pixels is not clipped
    count = min(len(dataset), _MAX_IMAGES)
    chosen = _of_one_channel(dataset.take([k * len(dataset) // count for k in range(count)]))
    if not angles and np.ptp(chosen.power, axis=(1, 2)).any():
        speckled = cut_off < MUCH_CLIPPED and examine_units(_upright(chosen, examined), examined)
        if not hot:
            examine_scaling(dataset, examined, speckled, cut_off)
    return examined


def _of_one_channel(dataset: Dataset) -> Dataset:
    """Return the first channel of stacks, since a mean over channels has more looks; other datasets unchanged."""
    if dataset.signal is None or not dataset.passes:
        return dataset
    entries = tuple(replace(entry, stack=None) for entry in dataset.entries)
    return replace(dataset, entries=entries, power=power_of(dataset.signal[:, 0]), signal=None)


def _upright(dataset: Dataset, examined: Examination) -> Dataset:
    """Return the dataset with near range on top, and with ground if images show it; add contradictions of that."""
    if dataset.views[0].aloft:
        examined.checks["orientation"] = "cannot be determined: what is aloft turns about any axis and has no shadow"
        return dataset
    if not all(_shaded_below(view, dataset.grid) for view in dataset.views):
        examined.checks["orientation"] = (
            "not examined: shadows fall to the sides of the images, for the azimuth axes are tilted too much"
        )
        return dataset
    edges = np.concatenate([dataset.power[:, [0, -1]].ravel(), dataset.power[:, :, [0, -1]].ravel()])
    ground = dataset.ground or bool(np.median(edges) > _MAX_EMPTY * bright_level(dataset.power))
    centred = dataset.calibration == "absolute"  # simulated or georeferenced, not cut out around a target
    look = partial(orientation, dataset.power, dataset.views, dataset.grid, centred=centred)
    estimate = look(ground=ground)
    if ground and not dataset.ground:
        if estimate.by_shadow:
            examined.contradictions.append(
                f"the dataset declares no ground, but images show shadow, {estimate.shadow.lead:.1f} dB darker than "
                "on the other sides of the target; import them without ground=False"
            )
        else:  # the floor may be noise
            ground = False
            estimate = look(ground=False)
    layout = Layout.of(dataset.source)
    if not estimate.by_shadow:
        signs = signs_of_map(dataset.power, dataset.views, dataset.grid, estimate, ground=ground)
        if signs:
            examined.contradictions.append(
                f"the images seem to be geocoded, for {signs}; import them with geocoded='level', or "
                "geocoded='terrain' with `terrain`, by what their producer took for the ground"
            )
            examined.checks["geometry"] = "see below"
            return dataset  # neither side is near range
    near = estimate.near or "top"
    examined.checks["near range"] = _near_range(estimate)
    geocoded = bool(dataset.source.get("geocoded"))
    examined.checks["azimuths"] = _WAS_MAP if geocoded else _azimuths(estimate)
    examined.checks["grazing angles"] = _WAS_MAP if geocoded else _grazing(estimate)
    if near != "top" or estimate.opposite:
        examined.contradictions.append(_orientation(dataset, estimate, near, layout, geocoded))
    if estimate.incidence:
        examined.contradictions.append(_incidence(dataset, estimate))
    examined.orientations.extend(_table(estimate, layout or Layout()))
    return replace(
        dataset, power=oriented(dataset.power, near), signal=None, grid=turned_grid(dataset.grid, near), ground=ground
    )


def _shaded_below(view: View, grid: ImageGrid) -> bool:
    """Return whether shadows fall downwards in the image rather than sideways."""
    across, away = view.look.gradients[:, :2] @ -view.direction[:2] / grid.spacing_m
    return bool(abs(across) < away)


def _orientation(dataset: Dataset, estimate: Orientation, near: Side, layout: Layout | None, geocoded: bool) -> str:
    """Describe a wrong orientation and its remedy."""
    opposite = estimate.opposite is True
    wrong = []
    if near != "top" and estimate.by_shadow:
        darker = f"{estimate.shadow.lead:.1f} dB darker there than on the other sides of the target"
        wrong.append(
            f"shadows fall {_SHADOW_DIRECTION[near]} ({darker}), so near range is at the {near} of the dataset's images"
        )
    elif near != "top":
        wrong.append(f"what is high leans to the {near} of the dataset's images, so near range is there")
    if opposite:
        higher = f"correlation higher by {-estimate.sense.mean:.2f}"
        wrong.append(f"images of neighbouring azimuths match better if azimuths run the other way ({higher})")
    unsure = "" if estimate.near else " (which side is near cannot be determined)"
    tilted = any(view.tilt_deg for view in dataset.views)
    remedy = _AZIMUTH_REMEDY[near] if geocoded else _remedy(near, opposite, layout, tilted)
    return f"{', and '.join(wrong)}; {remedy}{unsure}"


def _remedy(near: Side, opposite: bool, layout: Layout | None, tilted: bool) -> str:
    if layout is None:
        remedies = [f"turn the images (np.rot90(power, {SIDES.index(near)}, axes=(1, 2)))"] * (near != "top")
        if opposite:
            tilts = " and negate the tilts" * tilted  # the azimuth axis points the other way
            flip = f"flip the columns (power[:, :, ::-1]){tilts}"
            remedies.append(f"negate the azimuths, or {flip} if azimuths do run clockwise")
        return ", and ".join(remedies)
    mended = layout.corrected(near, opposite)
    if not opposite and not layout.mirrored:
        return f"import with {mended}"
    first, other = mended, mended.twin
    if near != "top" and opposite and mended.counter_clockwise:
        first, other = other, first  # a transposition is likelier than a turn and another sense
    sense = "counter-clockwise" if other.counter_clockwise else "clockwise"
    return f"import with {first}, or with {other} if the table's azimuths do run {sense}: images do not tell which"


def _incidence(dataset: Dataset, estimate: Orientation) -> str:
    grazings = [entry.view.grazing_deg for entry in dataset.entries]
    columns = dataset.source.get("columns")
    remedy = "give 90° less them"
    if isinstance(columns, dict) and columns.keys() & {"grazing", "incidence"}:
        wrong, right = ("grazing", "incidence") if "grazing" in columns else ("incidence", "grazing")
        remedy = f"import with `columns={{'{right}': '{columns[wrong]}'}}`"
    elif np.ptp(grazings) == 0:
        remedy += f" (`grazing_deg={90 - grazings[0]:g}`)"
    return (
        f"images match better if grazing angles ({min(grazings):.4g}° to {max(grazings):.4g}°) are incidence angles "
        f"(correlation higher by {-estimate.grazing.mean:.2f}); {remedy}"
    )


def _near_range(estimate: Orientation) -> str:
    if estimate.near is None:
        return "cannot be determined: neither shadows nor layover and bright edges tell, or there are too few images"
    if estimate.by_shadow:
        images = counted(estimate.shadow.count, "image")
        darker = f"{estimate.shadow.lead:.1f} dB darker beyond the target than on its other sides"
        return f"at the {estimate.near}: {darker}, in {images}"
    return f"at the {estimate.near}, to which what is high leans"


def _azimuths(estimate: Orientation) -> str:
    if estimate.opposite is None:
        return "cannot be determined: images 2° to 60° apart match as well in both senses, or are too few"
    sense = "in the opposite sense" if estimate.opposite else "as given"
    return (
        f"{counted(estimate.sense.count, 'pair')} of neighbouring views match better with azimuths {sense} "
        f"(correlation {abs(estimate.sense.mean):.2f} higher), which mirrored images with the other sense would, too"
    )


def _grazing(estimate: Orientation) -> str:
    if estimate.near is None or (not estimate.grazing.supports(0.0) and not estimate.incidence):
        return "cannot be determined: as grazing and as incidence angles they explain the images as well"
    better = "if they are incidence angles" if estimate.incidence else "as given than if they were incidence angles"
    return (
        f"{counted(estimate.grazing.count, 'pair')} of neighbouring views match better {better} (correlation "
        f"{abs(estimate.grazing.mean):.2f} higher)"
    )


def _table(estimate: Orientation, layout: Layout) -> list[tuple[str, ...]]:
    """Return the table of the eight orientations with the evidence for each."""
    rows: list[tuple[str, ...]] = [_TABLE]
    for k, side in enumerate(SIDES):
        for opposite in (False, True):
            notes = ["as it is"] * (side == "top" and not opposite)
            notes += ["best"] * (side == estimate.near and opposite == estimate.opposite)
            rows.append(
                (
                    str(layout.corrected(side, opposite)),
                    f"{estimate.shadow.mean[k]:.2f} dB" if estimate.shadow.count else "–",
                    f"{estimate.edge.mean[k]:+.2f}" if estimate.edge.count else "–",
                    f"{estimate.layover.mean[k]:.3f}" if estimate.layover.count else "–",
                    f"{estimate.correlation[side][opposite]:.3f}" if estimate.correlation else "–",
                    ", ".join(notes),
                )
            )
    return rows
