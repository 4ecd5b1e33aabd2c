"""The report's interactive widget: points that turn, and the SAR image of the nearest rendered direction beside them.

Images are rendered beforehand, at the views of some of the dataset's images and on a raster over the directions that
these span; as many as a number of bytes allows, whatever the size of an image.
"""

import base64
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Real, UInt8

from sarsplat.colours import DIFFERENCE, DIFFERENCE_IN_WORDS, HEIGHT, POWER, POWER_RAMPS, ramp
from sarsplat.data import Dataset
from sarsplat.data.coverage import largest_gap
from sarsplat.geometry import View
from sarsplat.geometry.view import seen_alike
from sarsplat.progress import stage
from sarsplat.radiometry import DYNAMIC_RANGE_DB, shade, white_level
from sarsplat.report.figure import colour_bar
from sarsplat.report.images import Difference, Part, address, fitted, indexed, png, power_bar, target_window
from sarsplat.report.views import evenly
from sarsplat.runs import Run

_BYTES = 900_000  # budget of the PNG of rendered images, and of the PNGs of true images and errors together
_LARGEST = 128  # pixels along a side
_MOST_RENDERED = 8_000_000  # cost (pixels + Gaussians) of all images on the raster
_BATCH_COST, _BATCH_IMAGES = 1_000_000, 8  # rendered at once, which bounds memory
_DEEPEST_DB, _SHALLOWEST_DB = 60.0, 10.0  # limits of the displayed dynamic range
_LEVELS = 120  # of brightness: half a decibel each
_FINEST_DEG = 5.0  # minimum step of the raster
_MOST_GRAZING, _MIN_AZIMUTHS = 5, 24  # maximum number of grazing angles of the raster; fewer if azimuths lack
_POINTS = 20_000
_TRIED = 4  # images used to estimate the bytes per image


def widget(run: Run) -> dict[str, Any] | None:
    """Values of `widget.html.j2`; None if the run has no points.

    Panels, colour bars, a text, `climbs` (images have several grazing angles), and the data for `widget.js`.
    """
    points, dataset = run.points, run.dataset
    if len(points) == 0:
        return None
    peak = white_level(dataset.images("train"))
    looks = None if dataset.clean_tests else dataset.looks  # then only test images are shown
    window = target_window(dataset.power, peak, dataset.score_margin)
    part = Part.of(dataset.grid, window, _LARGEST)
    difference = Difference(looks, dataset.grid, peak)

    chosen = _affordable(dataset, part, peak)
    views = [dataset.views[index] for index in chosen]
    cost = part.grid.rows * part.grid.columns + len(run.gaussians or ())
    parts: list[tuple[Any, ...]] = []
    for batch in _images(run, views, cost, "at the dataset's views"):
        done = sum(len(one) for one, *_ in parts)
        truth = dataset.power[chosen[done : done + len(batch)]]
        error = difference.of(truth, fitted(truth, batch, looks, dataset.score_margin))
        parts.append(tuple(part.of_images(images) for images in (batch, truth, error)))
    rendered, true, errors = (np.concatenate(of_all) for of_all in zip(*parts, strict=True))
    raster = _raster(dataset.views, _count(rendered, peak, cost))
    codes = [_codes(rendered, peak)]
    codes += [_codes(part.of_images(batch), peak) for batch in _images(run, raster, cost, "from all sides")]

    rows, columns = part.size
    low, high = np.quantile(points, (0.001, 0.999), axis=0)
    sample = np.random.default_rng(0).permutation(points)[:_POINTS]
    sample = sample[((sample >= low) & (sample <= high)).all(axis=1)]
    name = "measured" if dataset.calibration == "relative" else "true"
    panels = [
        part.panel("", "rendered SAR image at the radar's direction", canvas="sar-rendered"),
        part.panel("", f"nearest {name} SAR image", canvas="sar-true"),
        part.panel(
            "", f"error of the reconstruction at the view of that {name} image", canvas="sar-error", black=False
        ),
    ]
    lowest, highest = (bound(_angles(view)[1] for view in (*views, *raster)) for bound in (min, max))
    data = {
        "low": low.tolist(),
        "high": high.tolist(),
        "points": base64.b64encode(_quantised(sample, low, high).tobytes()).decode(),
        "rows": rows,
        "columns": columns,
        "deepest": _DEEPEST_DB,
        "shallowest": _SHALLOWEST_DB,
        "depth": DYNAMIC_RANGE_DB,
        "levels": _LEVELS,
        "views": [_angles(view) for view in (*views, *raster)],
        "sets": [dataset.entries[index].split for index in chosen],
        "dots": [[*_angles(entry.view), int(entry.split != "train")] for entry in dataset.entries],
        "rendered": _sheet(np.concatenate(codes)),
        "true": _sheet(_codes(true, peak)),
        "errors": _sheet(indexed(errors, -difference.largest, difference.largest)),
        "errorColours": ramp(DIFFERENCE).tolist(),
        "heightColours": ramp(HEIGHT)[:, :3].tolist(),
        "powerColours": {"grey" if name == POWER else name: ramp(name)[:, :3].tolist() for name in POWER_RAMPS},
        "name": name,
        "start": _angles(views[len(views) // 3]),
        "grazing": [lowest, highest],
    }
    text = (
        "Drag the points, or use the sliders, to move the radar around the target. Beside them is the SAR image of the "
        f"reconstruction from the nearest of {len(views) + len(raster)} precomputed directions, then "
        f"the nearest {name} image, and the error at its view ({difference.label}; {DIFFERENCE_IN_WORDS})."
    )
    if raster and raster[0].unusual not in {view.unusual for view in views}:
        text += " Directions that no image has are level and to the right, for the images differ in that."
    heights = colour_bar("height z, m", HEIGHT, float(low[2]), float(high[2]))
    bars = {"heights": heights, "powers": power_bar(), "errors": difference.bar}
    return {"panels": panels, **bars, "text": text, "climbs": highest - lowest >= _FINEST_DEG, "data": data}


def _images(run: Run, views: Sequence[View], cost: int, which: str) -> Iterator[Real[np.ndarray, "v rows columns"]]:
    """Render views in batches; an image costs `cost` (pixels + Gaussians)."""
    batch = min(max(1, _BATCH_COST // cost), _BATCH_IMAGES)
    with stage(f"report: images {which}", len(views)) as done:
        for first in range(0, len(views), batch):
            batch_views = views[first : first + batch]
            yield run.render(batch_views)
            done.advance(len(batch_views))


def _angles(view: View) -> list[float]:
    return [round(view.azimuth_deg % 360, 2), round(view.grazing_deg, 2)]


def _codes(power: Real[np.ndarray, "v rows columns"], peak: float) -> UInt8[np.ndarray, "v rows columns"]:
    """Decibels below the peak in steps of half a decibel: 0 is the darkest."""
    return np.round(_LEVELS * shade(power, peak, _DEEPEST_DB)).astype(np.uint8)


def _bytes_each(codes: UInt8[np.ndarray, "v rows columns"]) -> float:
    return len(png(codes.reshape(-1, codes.shape[2]))) / len(codes)


def _affordable(dataset: Dataset, part: Part, peak: float) -> list[int]:
    """Indices of the images that fit into the budget, evenly over the training and over the test views."""
    sample = dataset.power[evenly(len(dataset), _TRIED)]
    # an error takes about as many bytes as its image
    count = max(2, int(_BYTES / (2 * _bytes_each(_codes(part.of_images(sample), peak)))))
    around = sorted(range(len(dataset)), key=lambda index: _angles(dataset.views[index]))
    test = [index for index in around if dataset.entries[index].split != "train"]
    train = [] if dataset.clean_tests and test else [index for index in around if index not in set(test)]
    of_train = evenly(len(train), max(count - len(test), count // 2)) if train else []
    of_test = evenly(len(test), count - len(of_train)) if test else []
    return [train[k] for k in of_train] + [test[k] for k in of_test]


def _count(shown: Real[np.ndarray, "v rows columns"], peak: float, cost: int) -> int:
    """Number of raster images, each of `cost` (pixels + Gaussians), that fit into the budget besides those shown."""
    sample = shown[evenly(len(shown), _TRIED)]
    by_bytes = _BYTES / _bytes_each(_codes(sample, peak)) - len(shown)
    return max(0, int(min(by_bytes, _MOST_RENDERED / cost)))


def _raster(views: Sequence[View], count: int) -> list[View]:
    """At most `count` directions, evenly over the azimuths and grazing angles that the views span (`seen_alike`)."""
    if count < 1:
        return []
    gap = largest_gap(view.azimuth_deg for view in views)
    all_around = gap.width_deg <= 90
    first, span = (0.0, 360.0) if all_around else (gap.last_deg, 360 - gap.width_deg)
    lowest, highest = (bound(view.grazing_deg for view in views) for bound in (min, max))
    levels = min(_MOST_GRAZING, 1 + round((highest - lowest) / _FINEST_DEG))
    finest = math.ceil(span / _FINEST_DEG) + (not all_around)
    while levels > 1 and count // levels < min(finest, _MIN_AZIMUTHS):
        levels -= 1
    steps = max(1, min(finest, count // levels))
    grazing = np.linspace(lowest, highest, levels) if levels > 1 else [(lowest + highest) / 2]
    around = first + np.linspace(0, span, steps, endpoint=not all_around)
    return [seen_alike(views, float(a), float(g)) for g in grazing for a in around]


def _sheet(images: UInt8[np.ndarray, "v rows columns"]) -> dict[str, Any]:
    """All images in one PNG, row by row of a grid that is about square."""
    count, rows, columns = images.shape
    across = math.ceil(math.sqrt(count * rows / columns))
    down = math.ceil(count / across)
    filled = np.zeros((across * down, rows, columns), np.uint8)
    filled[:count] = images
    sheet = filled.reshape(down, across, rows, columns).swapaxes(1, 2).reshape(down * rows, across * columns)
    return {"uri": address(sheet), "across": across}


def _quantised(points: Real[np.ndarray, "p 3"], low: np.ndarray, high: np.ndarray) -> UInt8[np.ndarray, "p six"]:
    """16 bits for each coordinate between the corners, little-endian."""
    share = (points - low) / np.maximum(high - low, 1e-9)
    return np.round(65535 * share).astype("<u2").view(np.uint8).reshape(len(points), 6)
