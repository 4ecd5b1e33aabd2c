"""Set of chips: samples of runs from all around, each a function of the set's seed and its own number alone."""

import math
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex64, Float32
from scipy.ndimage import gaussian_filter
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.data.dataset_folder import read_header
from sarsplat.errors import SarsplatError, SarsplatWarning, shown
from sarsplat.geometry import ImageGrid, View
from sarsplat.geometry.view import seen_alike
from sarsplat.importers.pictures import likely_quantity, power_or_signal, read_pixels
from sarsplat.learning.method import DrawsSamples
from sarsplat.learning.sampler import LEARNED, UNIFORM, seed_of
from sarsplat.names import ChipFormat, ChipQuantity, ChipScale, Side, Speckle
from sarsplat.runs import Run
from sarsplat.runs.run_folder import names_of
from sarsplat.samples.encoding import Encoding
from sarsplat.settings.config import SCATTERERS

_AROUND = 360  # default number of chips of a run
_MOST = 100_000_000  # maximum number of chips of a set: file names have eight digits
_GOLDEN = (math.sqrt(5) - 1) / 2  # step between azimuths, turns: any number of them is spread evenly
_FAR_DEG = 10.0  # distance from the grazing angles of a training beyond which a warning is given
_GROUND_CELLS = 3.0  # standard deviation of the smoothing that removes a picture's speckle, resolution cells
_DECIMALS = 4  # decimals of drawn angles, degrees, so that the table of labels holds them exactly


@dataclass(frozen=True)
class Label:
    """Class, view and seed of a chip, and the index of its run in the set; `Run.sample(view, seed)` draws it again."""

    target: str
    view: View
    seed: int
    run: int


class Chips(torch.utils.data.Dataset[tuple[Tensor, int]]):
    """Chips that are drawn on access; made by `chips`, which describes arguments and errors.

    Chip i is of run i mod R, so that every beginning of a set is balanced.
    """

    def __init__(
        self,
        runs: Sequence[Run],
        count: int,
        azimuths_deg: Sequence[float],
        grazing_deg: tuple[float, float] | None,
        seed: int,
        encoding: Encoding,
        ground: str | Path,
        speckle: Speckle,
        scatterers: float,
    ) -> None:
        if not runs:
            raise SarsplatError("there are no runs to draw chips from; give at least one")
        if not 1 <= count <= _MOST // len(runs):
            raise SarsplatError(f"count is {count}; give 1 to {_MOST // len(runs)} chips of each run")
        self.runs, self.count, self.seed, self.encoding = tuple(runs), count, seed, encoding
        self.ground, self.speckle, self.scatterers = ground, speckle, scatterers
        for run in self.runs:
            encoding.require_room(run.grid, "the runs")
            one, other, first = run.grid, self.runs[0].grid, _name(self.runs[0])
            if (one.spacing_m, one.resolution_m, one.response) != (other.spacing_m, other.resolution_m, other.response):
                raise SarsplatError(
                    f"{_name(run)} has pixels of {_pixels(one)}, but {first} of {_pixels(other)}; draw chips from runs "
                    "with the same pixels, or make one set of each"
                )
            encoding.require_equal_sizes(one, _name(run), other, first)
        seed_of(seed, 0)  # refuses negative ones
        self.azimuths_deg = tuple(View(azimuth, 45.0).azimuth_deg % 360 for azimuth in azimuths_deg)
        self.grazing_deg = [_grazing(run) if grazing_deg is None else grazing_deg for run in self.runs]
        self._usual = [seen_alike(run.snapshot.views, 0.0, _grazing(run)[0]) for run in self.runs]
        for usual, ends in zip(self._usual, self.grazing_deg, strict=True):
            low, high = (replace(usual, grazing_deg=end).grazing_deg for end in ends)
            if low > high:
                raise SarsplatError(f"grazing {low:g}:{high:g} goes down; give the lower angle first")
        if grazing_deg is not None:
            warn_of_far_angles(self.runs, *grazing_deg, _FAR_DEG)
        _warn_of_poor_runs(self.runs)
        self.targets = tuple(target_of(run) for run in self.runs)
        self.classes = tuple(dict.fromkeys(self.targets))
        """Names of the classes, by class number."""
        self.serials = tuple(_serial_of(run) for run in self.runs)
        """Serial number of the vehicle that each run shows; "" if unknown or several."""
        require_distinct_folders(map(_shows, self.runs))
        _ = self._draw  # raises if a run cannot draw such samples

    def __getstate__(self) -> dict[str, Any]:
        """State for pickling without caches: worker processes read the runs again."""
        caches = ("_draw", "brightest")
        state = {name: value for name, value in vars(self).items() if name not in caches}
        return state | {"runs": tuple(replace(run) for run in self.runs)}

    @cached_property
    def _draw(self) -> list[DrawsSamples]:
        backdrops = [backdrop_of(self.ground, run.grid) for run in self.runs]
        draw = []
        for run, backdrop in zip(self.runs, backdrops, strict=True):
            try:
                draw.append(run.reconstruction.sampler(backdrop, self.speckle, self.scatterers))
            except SarsplatError as error:
                if len(self.runs) == 1:
                    raise
                raise SarsplatError(f"{_name(run)}: {error}") from error
        return draw

    @cached_property
    def brightest(self) -> float:
        """Largest power of all runs' training images, β⁰."""
        return max(run.brightest for run in self.runs)

    def __len__(self) -> int:
        return self.count * len(self.runs)

    def __getitem__(self, index: int) -> tuple[Tensor, int]:
        """Chip [1, rows, columns], uint8, float32 or complex64 by the encoding, and its class number."""
        pixels = self.encoding.stored(self.sample(index), self.brightest)
        return torch.from_numpy(pixels)[None], self.classes.index(self.targets[index % len(self.runs)])

    def label(self, index: int) -> Label:
        """Label of a chip; raises IndexError beyond the last, which ends loops."""
        if not 0 <= index < len(self):
            raise IndexError(f"chip {index} of a set of {len(self)}")
        number, place = divmod(index, len(self.runs))
        if self.azimuths_deg:
            azimuth = self.azimuths_deg[number % len(self.azimuths_deg)]
        else:
            azimuth = round(360 * ((self._starts[place] + number * _GOLDEN) % 1), _DECIMALS) % 360
        low, high = self.grazing_deg[place]
        seed = seed_of(self.seed, place, number)
        drawn = np.random.default_rng([seed, 1]).uniform(low, high)  # `Run.sample` begins with [seed]
        grazing = min(max(round(float(drawn), _DECIMALS), low), high)
        view = replace(self._usual[place], azimuth_deg=azimuth, grazing_deg=grazing)
        return Label(self.targets[place], view, seed, place)

    def sample(self, index: int) -> Complex64[np.ndarray, "rows columns"]:
        """Chip before encoding: complex amplitudes √β⁰·e^jψ on the run's grid, row 0 near."""
        label = self.label(index)
        return self._draw[label.run](label.view, label.seed)

    @cached_property
    def _starts(self) -> list[float]:
        """Start azimuth of each run, in turns."""
        seeds = [seed_of(self.seed, place) for place in range(len(self.runs))]
        return [float(np.random.default_rng([seed, 2]).random()) for seed in seeds]  # 0 and 1 are of chips


@checks_arguments
def chips(
    runs: Sequence[Run | str | Path],
    *,
    count: int | None = None,
    azimuths_deg: Sequence[float] = (),
    grazing_deg: tuple[float, float] | None = None,
    seed: int = 0,
    quantity: ChipQuantity = "magnitude",
    scale: ChipScale = "max",
    format: ChipFormat = "jpeg",
    jpeg_quality: int = 75,
    crop: int | None = None,
    near: Side = "bottom",
    ground: str | Path = "learned",
    speckle: Speckle = "response",
    scatterers: float = SCATTERERS,
) -> Chips:
    """Chips for training a classifier, drawn from runs as the radar would deliver them: a torch Dataset.

    A chip depends only on the seed, the index of its run and its number within that run: not on the number of chips,
    their order of access, or workers. Each has a random view, gain and displacement, distributed as in the training
    images, and speckle and noise (`Run.sample`).

    Parameters
    ----------
    runs : sequence of Run or path
        Runs, or their folders; a class is the target that a run's dataset names, or else the name of its folder.
    count : int, optional
        Number of chips of each run; by default that of the azimuths, or 360.
    azimuths_deg : sequence of float
        Azimuths of each run's chips, cyclic, degrees; by default, chips are spread evenly all around.
    grazing_deg : (float, float), optional
        Lowest and highest random grazing angle, degrees; by default those of each run's training images.
    seed : int
        Seed of the set, at least 0.
    quantity, scale, format, jpeg_quality, crop, near
        See `Encoding`; pixels are those of files in that format.
    ground : str or Path
        "learned" or "uniform" (see `Run.sample`), or a picture (see `backdrop_of`).
    speckle, scatterers
        See `Run.sample`.

    Returns
    -------
    Chips
        Pairs of a tensor [1, rows, columns], uint8, or float32 or complex64 with `format="npy"`, and the class number,
        an index of `classes`.

    Raises
    ------
    SarsplatError
        If there are no runs, one cannot be read or draws no samples, grids differ, an angle is out of range, or choices
        are unknown or contradict each other.
    """
    # JSON cannot hold numpy's numbers, and spells 17 and 17.0 differently
    encoding = Encoding(quantity, scale, format, int(jpeg_quality), None if crop is None else int(crop), near)
    opened = [run if isinstance(run, Run) else Run.load(run) for run in runs]
    azimuths = tuple(azimuths_deg)
    number = (len(azimuths) or _AROUND) if count is None else int(count)
    between = None if grazing_deg is None else (float(grazing_deg[0]), float(grazing_deg[1]))
    return Chips(opened, number, azimuths, between, int(seed), encoding, ground, speckle, float(scatterers))


def backdrop_of(ground: str | Path, grid: ImageGrid) -> str | Float32[np.ndarray, "r c"]:
    """Read the ground of samples, as `Run.sample` takes it, from a picture.

    Parameters
    ----------
    ground : str or Path
        A picture of ground, with pixels of the images' size and near range at the top: amplitudes if they are whole
        numbers, or complex; or one of the words "learned" and "uniform", which are returned.
    grid : ImageGrid
        Grid of the images: speckle is smoothed over three of its resolution cells.

    Returns
    -------
    str or numpy.ndarray, float32 [R, C]
        The word; or linear power without speckle, relative to its mean.

    Raises
    ------
    SarsplatError
        If the picture cannot be read, or is black.
    """
    if str(ground) in (LEARNED, UNIFORM):
        return str(ground)
    path = Path(ground)
    if not path.suffix:
        raise SarsplatError(f"ground is {shown(str(ground))}; give {LEARNED}, {UNIFORM} or the file of a picture")
    pixels = read_pixels(path)
    if pixels.dtype.kind == "f" and pixels.ndim == 2:
        raise SarsplatError(
            f"{path} holds {pixels.dtype} numbers, which may be amplitude or power; store amplitudes as whole numbers"
        )
    power = power_or_signal(pixels, likely_quantity(pixels, str(path)), str(path))
    power = np.abs(power) ** 2 if np.iscomplexobj(power) else power
    if not power.any():
        raise SarsplatError(f"{path} is black; give a picture of ground")
    sigma = [_GROUND_CELLS * grid.cell_m / spacing for spacing in reversed(grid.spacing_m)]
    smooth = gaussian_filter(power.astype(np.float64), sigma, mode="nearest")
    factor: Float32[np.ndarray, "r c"] = (smooth / smooth.mean()).astype(np.float32)
    return factor


def target_of(run: Run) -> str:
    """Class of a run, as a valid folder name."""
    return folder_name(_shows(run))


def folder_name(target: str) -> str:
    """Class as a valid folder name."""
    return re.sub(r"[^\w+-]", "_", target)


def require_distinct_folders(targets: Iterable[str]) -> None:
    """Raise if two classes would share a folder."""
    first: dict[str, str] = {}
    for target in targets:
        if (other := first.setdefault(folder_name(target), target)) != target:
            raise SarsplatError(
                f"{shown(other)} and {shown(target)} are two classes whose folders would both be called "
                f"{folder_name(target)}; make a set of each"
            )


def one_serial(source: Mapping[str, Any]) -> str:
    """Serial number of the vehicle in a dataset's source; "" for none or several."""
    serials = source.get("serials")
    return str(serials[0]) if isinstance(serials, list) and len(serials) == 1 else ""


def _serial_of(run: Run) -> str:
    """Vehicle serial of the run's dataset; "" if the dataset has moved, has changed or names none."""
    with suppress(SarsplatError):
        if run.images is None and run.dataset_path is not None and not one_serial(read_header(run.dataset_path).source):
            return ""
        return one_serial(run.dataset.source)
    return ""


def _shows(run: Run) -> str:
    return run.target or (_name(run) if run.path is None else run.path.absolute().name)


def _name(run: Run) -> str:
    return "the run in memory" if run.path is None else names_of([run.path])[0]


def warn_of_far_angles(runs: Sequence[Run], lowest: float, highest: float, most_deg: float) -> None:
    """Warn of grazing angles more than `most_deg` from the training's: the shape is not known from there."""
    for run in runs:
        low, high = _grazing(run)
        far = max(low - lowest, highest - high)
        if far > most_deg:
            warnings.warn(
                f"grazing angles of {lowest:g}° to {highest:g}° are up to {far:.0f}° from those that a run of "
                f"{target_of(run)} has seen ({low:.4g}° to {high:.4g}°), which may not know the target from there",
                SarsplatWarning,
                stacklevel=4,
            )
            return


def _warn_of_poor_runs(runs: Sequence[Run]) -> None:
    """Warn of runs that are not evaluated, or worse than a two-dimensional baseline."""
    from sarsplat.evaluation import beaten

    folders = [run.path for run in runs if run.path is not None]
    names = dict(zip(folders, names_of(folders), strict=True))
    scores = [(_name(run) if run.path is None else names[run.path], run.metrics) for run in runs]
    unknown = [name for name, metrics in scores if metrics is None or not metrics["images"]]
    worse = [(name, one) for name, metrics in scores if metrics is not None for one in beaten(metrics)]
    sentences = []
    if worse:
        name, one = max(worse, key=lambda each: abs(each[1].best - (each[1].own or 0.0)))
        more = len({name for name, _ in worse}) - 1
        others = f" (and so for {more} of the other runs)" if more else ""
        sentences.append(
            f"{one.sentence(name)}{others}; its chips may teach a classifier less than the training images do"
        )
    if unknown:
        first = f"{unknown[0]}{f' and {len(unknown) - 1} more' if len(unknown) > 1 else ''}"
        sentences.append(
            f"{first} {'was' if len(unknown) == 1 else 'were'} never evaluated on unseen images, so whether the chips "
            "look like these is not known; run `sarsplat evaluate RUN`, of a dataset with test images"
        )
    for sentence in sentences:
        warnings.warn(sentence, SarsplatWarning, stacklevel=4)


def _pixels(grid: ImageGrid) -> str:
    spacing, resolution = (" m × ".join(f"{side:.4g}" for side in pair) for pair in (grid.spacing_m, grid.resolution_m))
    return f"{spacing} m, a resolution of {resolution} m and a {grid.response.kind} response"


def _grazing(run: Run) -> tuple[float, float]:
    """Lowest and highest grazing angle of the training images."""
    angles = [view.grazing_deg for view in run.snapshot.views]
    return min(angles), max(angles)
