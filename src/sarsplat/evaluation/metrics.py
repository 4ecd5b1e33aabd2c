"""Table of metrics: name, unit, direction, definition, requirements and function of each.

Evaluation, `metrics.json`, terminal, report, README and documentation use this table. To add a metric, write its
function and add an entry.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from sarsplat.data import Dataset
from sarsplat.evaluation import images
from sarsplat.evaluation.azimuths import CLOSE_DEG, REVERSED_DEG, STEP_DEG
from sarsplat.evaluation.images import REACH, MaskPair, Stack, UndefinedScore
from sarsplat.evaluation.left_open import undetermined
from sarsplat.evaluation.lpips import WEIGHTS_VARIABLE, Lpips, lpips
from sarsplat.evaluation.points import NORMALS_OFF_DEG, PointMetrics, Yardstick
from sarsplat.geometry import SHADOW, TARGET
from sarsplat.runs import Run


@dataclass(frozen=True)
class Requirement:
    """Condition on a dataset for a metric to apply, and the reason where it is not met."""

    met: Callable[[Dataset], bool]
    otherwise: str


NOTHING = Requirement(lambda dataset: True, "")

Measured = TypeVar("Measured")


@dataclass(frozen=True)
class Metric(Generic[Measured]):
    """A metric of one kind of measured objects: images, masks, azimuths, points or runs."""

    key: str
    """Name in `metrics.json`."""
    label: str
    """Name for readers, without the unit."""
    unit: str
    """Unit; empty if it has none."""
    digits: str
    """Format specification of its value."""
    better: Literal["more", "less"] | None
    """Direction of better values; None if it has none."""
    definition: str
    """Exact definition in one line."""
    compute: Callable[[Measured], float]
    """Function that returns its value or raises `UndefinedScore`."""
    requires: Requirement = NOTHING
    short: str = ""
    """Heading of its column in terminal and README, without the unit; empty if it has no column there."""
    place: Literal["headline", "table", "file"] = "table"
    """Place in the report: at the top and in the table, in the table only, or nowhere."""

    @property
    def title(self) -> str:
        """Label and unit: `Chamfer distance, m`."""
        return f"{self.label}, {self.unit}" if self.unit else self.label

    @property
    def heading(self) -> str:
        """Short name and unit: `CD m`."""
        return f"{self.short} {self.unit}".strip()

    @property
    def arrow(self) -> str:
        """↑ if more is better, ↓ if less is."""
        return {"more": "↑", "less": "↓", None: ""}[self.better]

    def text(self, value: float | None) -> str:
        """The value with the metric's digits; a dash for None."""
        return "–" if value is None else f"{value:{self.digits}}".rstrip(".")

    def best(self, values: Sequence[float | None]) -> float | None:
        """Best of several values; None if there is nothing to compare."""
        defined = [value for value in values if value is not None]
        if self.better is None or len(defined) < 2:
            return None
        return max(defined) if self.better == "more" else min(defined)


@dataclass(frozen=True)
class ImagePair:
    """True and rendered images of one test set, with parameters of their scores."""

    truth: Stack
    rendered: Stack
    """β⁰, linear power."""
    reference_amplitude: float
    """Largest amplitude √β⁰ of the training set, or of the test images if these alone are without speckle."""
    mean_power: float
    """Mean β⁰ of the training set."""
    score_margin: int
    """Pixels excluded on each side where speckled images are scored."""
    network: Lpips | None = None


def image_parameters(dataset: Dataset) -> dict[str, Any]:
    """Attributes of `ImagePair` that depend on the dataset alone; the metrics' definitions refer to them."""
    train = dataset.images("train")
    tests = [dataset.images(split) for split in dataset.splits() if split != "train"]
    # speckle peaks, several times as bright as the target, would raise every score of clean test images
    clean = tests if dataset.clean_tests and tests else [train]
    return {
        "reference_amplitude": float(np.sqrt(max(images.max() for images in clean))),
        "mean_power": float(train.mean(dtype=np.float64)),
        "score_margin": dataset.score_margin,
    }


def _speckled(dataset: Dataset) -> bool:
    return dataset.looks is not None


NOISE_FREE = Requirement(
    lambda dataset: not _speckled(dataset), "the true images are speckled; this metric needs noise-free ones"
)
SPECKLED = Requirement(_speckled, "the true images are noise-free; this metric needs speckled ones")
GROUND = Requirement(lambda dataset: dataset.ground, "the images show no ground, so no shadow is visible")
KNOWN_SURFACE = Requirement(
    lambda dataset: dataset.truth_mesh is not None, "the dataset has no true mesh to compare with"
)


def _lpips(pair: ImagePair) -> float:
    if pair.network is None:
        raise UndefinedScore(f"no LPIPS weights; give their folder as `lpips_weights` or in {WEIGHTS_VARIABLE}")
    return lpips(pair.truth, pair.rendered, pair.reference_amplitude, pair.network)


def _nats_per_pixel(pair: ImagePair) -> float:
    # divided in float64: in float32 faint images are not multiples of each other
    truth, rendered = (power.astype(np.float64) / pair.mean_power for power in (pair.truth, pair.rendered))
    return images.nats_per_pixel(truth, rendered, pair.score_margin)


def _registered_nats(pair: ImagePair) -> float:
    best = images.register(pair.truth, pair.rendered, pair.score_margin)
    return float(best.nats.mean() - np.log(pair.mean_power))


_noise_free = partial(Metric[ImagePair], requires=NOISE_FREE)
_speckled_only = partial(Metric[ImagePair], requires=SPECKLED)

IMAGE_METRICS: tuple[Metric[ImagePair], ...] = (
    _noise_free(
        *("psnr_db", "PSNR, whole image", "dB", ".2f", "more"),
        "peak signal-to-noise ratio of the amplitude √β⁰ / reference_amplitude, not clipped, peak 1; mean over images",
        lambda pair: images.psnr_db(pair.truth, pair.rendered, pair.reference_amplitude),
        short="PSNR",
        place="headline",
    ),
    _noise_free(
        *("psnr_target_db", "PSNR on the target", "dB", ".2f", "more"),
        f"the same over pixels whose true β⁰ is less than {images.TARGET_DYNAMIC_DB:g} dB below the test set's maximum",
        lambda pair: images.psnr_target_db(pair.truth, pair.rendered, pair.reference_amplitude),
        short="target",
        place="headline",
    ),
    _noise_free(
        *("ssim", "SSIM", "", ".4f", "more"),
        "structural similarity of the same amplitudes: 11×11 Gaussian window of standard deviation 1.5, data range 1; "
        "mean over images",
        lambda pair: images.ssim(pair.truth, pair.rendered, pair.reference_amplitude),
        short="SSIM",
    ),
    _noise_free(
        *("lpips", "LPIPS", "", ".4f", "less"),
        "LPIPS-AlexNet v0.1 of 2·amplitude − 1, grey repeated three times; mean over images",
        _lpips,
        short="LPIPS",
    ),
    _speckled_only(
        *("registered_nats_per_pixel", "negative log-likelihood, registered", "nats/pixel", ".3f", "less"),
        f"nats_per_pixel of each image shifted by up to {REACH} pixels, to fit its truth best, and multiplied by "
        "mean(I/S); mean over images",
        _registered_nats,
        short="NLL reg.",
        place="headline",
    ),
    _speckled_only(
        *("registered_log_correlation", "correlation of log power, registered", "", ".3f", "more"),
        f"log_correlation of each image shifted by up to {REACH} pixels to fit its truth best; mean over images",
        lambda pair: images.registered_log_correlation(pair.truth, pair.rendered, pair.score_margin),
        short="corr. reg.",
        place="headline",
    ),
    _speckled_only(
        *("nats_per_pixel", "negative log-likelihood", "nats/pixel", ".3f", "less"),
        "negative log-likelihood of single-look speckle: mean of log S + I/S, I and S in units of mean_power, "
        "excluding score_margin pixels on each side",
        _nats_per_pixel,
    ),
    _speckled_only(
        *("log_correlation", "correlation of log power", "", ".3f", "more"),
        "correlation of the logarithms of 3×3 means, excluding score_margin pixels on each side; mean over images",
        lambda pair: images.log_correlation(pair.truth, pair.rendered, pair.score_margin),
    ),
)
"""Metrics of images from unseen views; those of images without speckle come first."""


def leading_metric(dataset: Dataset) -> Metric[ImagePair]:
    """Image metric that is shown first for this dataset."""
    return next(metric for metric in IMAGE_METRICS if metric.place == "headline" and metric.requires.met(dataset))


MASK_METRICS: tuple[Metric[MaskPair], ...] = (
    Metric(
        *("target_iou", "IoU of the target's mask", "", ".3f", "more"),
        "intersection over union of the target's pixels in the predicted and the true mask; for speckled images after "
        "the shift of registered_nats_per_pixel; mean over images",
        lambda masks: masks.iou(TARGET),
        short="target IoU",
        place="headline",
    ),
    Metric(
        *("shadow_iou", "IoU of the shadow's mask", "", ".3f", "more"),
        "the same for the pixels in shadow",
        lambda masks: masks.iou(SHADOW),
        requires=GROUND,
        short="shadow IoU",
        place="headline",
    ),
)
"""Metrics of predicted masks of target and shadow."""


LOCATABLE = Requirement(
    lambda dataset: _speckled(dataset) and dataset.ground and not dataset.passes,
    "azimuths are found in speckled images of one channel that show ground",
)
_of_azimuths = partial(Metric[np.ndarray], requires=LOCATABLE)

AZIMUTH_METRICS: tuple[Metric[np.ndarray], ...] = (
    _of_azimuths(
        *("azimuth_error_deg", "azimuth error, median", "°", ".2f", "less"),
        f"median absolute error of the azimuths at which images are most likely, among predictions every {STEP_DEG:g}° "
        "around, displaced by up to 3 resolution cells, of any gain",
        lambda errors: float(np.median(np.abs(errors))),
        short="azimuth",
    ),
    _of_azimuths(
        *(f"azimuth_within@{CLOSE_DEG:g}", f"azimuth within {CLOSE_DEG:g}°", "", ".3f", "more"),
        f"share of the images for which that error is at most {CLOSE_DEG:g}°",
        lambda errors: float(np.mean(np.abs(errors) <= CLOSE_DEG)),
    ),
    _of_azimuths(
        *("azimuth_reversed", "azimuth reversed", "", ".3f", "less"),
        f"share of the images for which that error is more than {REVERSED_DEG:g}°",
        lambda errors: float(np.mean(np.abs(errors) > REVERSED_DEG)),
    ),
)
"""Metrics of the errors of azimuths, degrees, that are found in the images of a set."""

UNSEEN_METRICS: tuple[Metric[Any], ...] = (*IMAGE_METRICS, *MASK_METRICS, *AZIMUTH_METRICS)
"""Metrics of a test set."""


_of_points = partial(Metric[PointMetrics], requires=KNOWN_SURFACE)


def _of_normals(value: float | None) -> float:
    if value is None:
        raise UndefinedScore("these points have no normals")
    return value


def metrics_of_points(yardstick: Yardstick) -> tuple[Metric[PointMetrics], ...]:
    """Metrics of reconstructed points; their names contain the thresholds."""
    (cell, middle, _), voxel = yardstick.thresholds_m, f"{yardstick.voxel_m:.3g} m"
    return (
        _of_points(
            *("cd_m", "Chamfer distance", "m", "#.3g", "less"),
            "mean of accuracy and completeness",
            lambda points: points.cd_m,
            short="CD",
            place="headline",
        ),
        _of_points(
            *("cd_squared_m2", "Chamfer distance, squared", "m²", "#.3g", "less"),
            "the same for squared distances",
            lambda points: points.cd_squared_m2,
            place="file",
        ),
        _of_points(
            *("accuracy_m", "accuracy (points → truth)", "m", "#.3g", "less"),
            f"mean distance from the reconstructed points, one per {voxel} voxel, to the true triangles",
            lambda points: points.accuracy_m,
        ),
        _of_points(
            *("completeness_m", "completeness (truth → points)", "m", "#.3g", "less"),
            "mean distance from a million samples of the true surface to the nearest reconstructed point",
            lambda points: points.completeness_m,
        ),
        _of_points(
            *(f"precision@{cell:g}", f"precision at {cell:g} m", "", ".3f", "more"),
            f"share of the reconstructed points within {cell:g} m of the true surface",
            lambda points: points.precision[cell],
            place="file",
        ),
        _of_points(
            *(f"recall@{cell:g}", f"recall at {cell:g} m", "", ".3f", "more"),
            f"share of the true surface's samples within {cell:g} m of a reconstructed point",
            lambda points: points.recall[cell],
            place="file",
        ),
        *(
            _of_points(
                *(f"f1@{threshold:g}", f"F1 at {threshold:g} m", "", ".3f", "more"),
                f"harmonic mean of precision and recall at {threshold:g} m",
                lambda points, threshold=threshold: points.f1[threshold],  # type: ignore[misc]
                short="" if threshold == middle else f"F1@{threshold:g}",
                place="headline" if threshold == cell else "table",
            )
            for threshold in yardstick.thresholds_m
        ),
        _of_points(
            *("normals_deg", "normals off, median", "°", ".1f", "less"),
            "median angle between the normal of a point compared and that of the nearest true triangle, whatever their "
            "signs; of a mesh, of points spread by area",
            lambda points: _of_normals(points.normals_deg),
        ),
        _of_points(
            *(f"normals_off@{NORMALS_OFF_DEG:g}", f"normals off by more than {NORMALS_OFF_DEG:g}°", "", ".3f", "less"),
            f"share of the points compared for which that angle is more than {NORMALS_OFF_DEG:g}°",
            lambda points: _of_normals(points.normals_off),
        ),
        _of_points(
            *("count", "points compared", "", ".0f", None),
            "number of reconstructed points compared, after thinning",
            lambda points: points.count,
            place="file",
        ),
    )


def _time_s(run: Run) -> float:
    if not run.time_s:
        raise UndefinedScore("these Gaussians were not trained here, so the training time is not known")
    return run.time_s


RUN_METRICS: tuple[Metric[Run], ...] = (
    Metric(*("time_s", "training time", "s", ".0f", "less"), "wall-clock time of the training", _time_s, short="time"),
    Metric(
        *("undetermined", "surface that images leave open", "", ".3f", None),
        "share of the points whose height along the normal no edge or texture within 4 cells fixes to one cell",
        undetermined,
    ),
)
"""Metrics of a run as a whole."""


def all_metrics(yardstick: Yardstick) -> tuple[Metric[Any], ...]:
    """Every metric, in the order of tables."""
    return (*UNSEEN_METRICS, *metrics_of_points(yardstick), *RUN_METRICS)


def compute_all(
    metrics: Sequence[Metric[Measured]],
    dataset: Dataset,
    measured: Measured | UndefinedScore,
    prefix: str,
    reasons: dict[str, str],
) -> dict[str, float | None]:
    """Compute all metrics; None for those that do not apply to the dataset or are undefined.

    `reasons` gets `prefix` (empty, or ending in a dot) and key of each metric that is None, and why.
    """
    values: dict[str, float | None] = {}
    for metric in metrics:
        try:
            if not metric.requires.met(dataset):
                raise UndefinedScore(metric.requires.otherwise)
            if isinstance(measured, UndefinedScore):
                raise measured
            values[metric.key] = metric.compute(measured)
        except UndefinedScore as undefined:
            values[metric.key] = None
            reasons[prefix + metric.key] = str(undefined)
    return values
