"""Settings chosen by evidence: a short training shows whether images differ in gain and position, as measured ones do.

A scene explains no factor that target and ground of one image have in common. Images are measured ones, with gains and
shifts, if the log gains of target and ground covary over the images, or if most images fit better at a displaced
position on which their even and odd rows agree.
"""

import itertools
import math
import warnings
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64

from sarsplat.data import Dataset
from sarsplat.errors import counted
from sarsplat.geometry import ImageGrid
from sarsplat.learning.scene_frame import Levels
from sarsplat.learning.trainer import Trainer
from sarsplat.radiometry import to_db
from sarsplat.settings import PRESETS, Config
from sarsplat.settings.sections import FlatGround, Surroundings

_SHARE = 0.1  # length of the trial, relative to the training
_PIXELS = 256  # side of the images of the trial at most: larger ones are multilooked
_SMOOTHED_DROPOUT = 0.4  # dropout where there are coarser levels, at which smoothed surfaces average speckle already
_SMOOTHED_PENALTY = 0.3  # penalty there for scattering that differs, for the same reason
_SMOOTHED_FLOOR = 0.01  # power added there to images: for darker shadows, smoothed surfaces are deformed as a whole
_ONE_SIDED = 0.5  # length of the views' mean horizontal direction, 0 to 1, from which on layover looks like ground
_FEWEST = 4  # minimum number of images, and of gains: fewer do not separate gains from the ground's power law in sin θ
_GROUND_DB = 1.5  # maximum distance of ground pixels from the rendering's median, dB
_TARGET_DB = 6.0  # minimum level of target pixels above that median, dB
_GAIN_DB = 0.25  # minimum standard deviation of gains that are learned, dB: roads and dense scenes leave up to 0.2 dB


@dataclass(frozen=True)
class Differences:
    """Differences between training images that no scene explains."""

    gain_std_db: float
    """Standard deviation of the gain that target and ground of an image have in common, dB, ≥ 0."""
    displaced: int
    """Number of images that fit better at another position, on which even and odd rows agree."""
    nats: float
    """Change of the loss by shifts and gains, if they are worth their parameters, nats per pixel, ≤ 0."""


def chosen(dataset: Dataset) -> Config:
    """Return settings for images with speckle on ground; their `evidence` has the measurements that chose them.

    Images with gains or shifts are measured ones: targets that are learned at full resolution only (one level) get the
    preset `measured`, larger scenes `scene` with all nuisances. The trial runs on the CPU.
    """
    scene = PRESETS["scene"]
    train = dataset.select("train")
    if len(train) < _FEWEST:
        return replace(scene, evidence=f"scene, as fewer than {_FEWEST} images allow no trial")
    factor = -(-max(dataset.grid.rows, dataset.grid.columns) // _PIXELS)
    train = train.multilooked(factor)
    trainer = _trial(train, scene)
    found = differences(train, trainer)
    multilevel = Levels.of(scene, replace(trainer.model.frame, grid=dataset.grid)).coarsest > 1
    if multilevel:
        sides = np.array([view.direction[:2] for view in train.views])
        around = np.linalg.norm(sides.sum(0)) < _ONE_SIDED * np.linalg.norm(sides, axis=1).sum()
        ground = FlatGround(from_images=bool(around))
        scene = replace(scene, dropout=_SMOOTHED_DROPOUT, scattering_penalty=_SMOOTHED_PENALTY, ground=ground)
        scene = scene.with_settings({"surroundings.speckle_floor": _SMOOTHED_FLOOR})
    images = counted(len(train), "image")
    summary = f"gains of images differ by {found.gain_std_db:.2g} dB, {found.displaced} of {images} displaced"
    if found.nats >= 0:
        return replace(scene, evidence=f"scene: {summary}; too little, so neither gains nor shifts are learned")
    summary = f"{summary} ({found.nats:.4f} nats per pixel)"
    if not multilevel:
        return replace(PRESETS["measured"], evidence=f"measured: {summary}")
    kept = {name: getattr(scene.surroundings, name) for name in ("noise_floor", "speckle_floor")}
    rates = replace(scene.rates, nuisance=PRESETS["measured"].rates.nuisance)  # gains as there
    scene = replace(scene, surroundings=Surroundings(**kept), scattering_penalty=0.0, rates=rates)
    return replace(scene, evidence=f"scene with nuisances of each image: {summary}")


def _trial(dataset: Dataset, scene: Config) -> Trainer:
    """Train for a tenth of the iterations, on the CPU."""
    config = replace(
        scene,
        iterations=math.ceil(_SHARE * scene.iterations),
        smoothing=replace(scene.smoothing, rounds=round(_SHARE * scene.smoothing.rounds)),
        relocation=replace(scene.relocation, rounds=round(_SHARE * scene.relocation.rounds)),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the training itself repeats them
        trainer = Trainer(dataset, config, device="cpu")
        for _ in range(config.iterations):
            trainer.step()
    return trainer


def differences(train: Dataset, trainer: Trainer) -> Differences:
    """Compare the training images with renderings of a short training."""
    expected = [trainer.rendered([view])[0].astype(np.float64) for view in train.views]  # in float64, one at a time
    independent = train.grid.independent_samples * (train.looks or 1.0)
    per_parameter = math.log(independent) / (2 * independent)  # Schwarz's criterion, nats per sample and parameter
    gain_variance = _common_variance(train, expected)
    gain_std_db = float(to_db(math.exp(math.sqrt(gain_variance))))
    gain_nats = gain_variance / 2 - per_parameter if gain_std_db > _GAIN_DB else 0.0
    losses = np.array([_displaced(one, image, train.grid) for one, image in zip(expected, train.power, strict=True)])
    common = losses.sum(axis=(0, 1)).argmin()  # a displacement of all images alike is the scene's
    even, odd = losses.argmin(axis=2).T
    displaced, k = int(((even == odd) & (even != common)).sum()), np.arange(len(losses))
    # cross-validated: the loss of odd rows at the best place of even ones, and the reverse
    cross = losses[k, 1, even] - losses[k, 1, common] + losses[k, 0, odd] - losses[k, 0, common]
    shift_nats = -cross.mean() / 2 - 2 * per_parameter if displaced > len(losses) / 2 else 0.0
    return Differences(gain_std_db, displaced, 0.0 - max(gain_nats, 0.0) - max(shift_nats, 0.0))


def _common_variance(train: Dataset, expected: list[Float64[np.ndarray, "rows columns"]]) -> float:
    """Return the covariance of the log gains of target and ground, after regression on log sin θ; at least 0."""
    gains = []
    for one, image in zip(expected, train.power, strict=True):
        level_db = to_db(one, np.median(one))
        ratio = image / one
        parts = ratio[abs(level_db) < _GROUND_DB], ratio[level_db > _TARGET_DB]
        gains.append([math.log(part.mean()) if part.size and part.any() else math.nan for part in parts])
    known = np.isfinite(gains).all(axis=1)
    if known.sum() < _FEWEST:
        return 0.0
    sines = np.log([view.look.sine for view in train.views])[known]
    design = np.column_stack([np.ones_like(sines), sines - sines.mean()])[:, : 1 + (np.ptp(sines) > 0)]
    ground, target = np.array(gains)[known].T
    rest = [values - design @ np.linalg.lstsq(design, values, rcond=None)[0] for values in (ground, target)]
    return max(float(rest[0] @ rest[1]) / (len(sines) - design.shape[1]), 0.0)


def _displaced(
    expected: Float64[np.ndarray, "rows columns"], image: Float[np.ndarray, "rows columns"], grid: ImageGrid
) -> list[list[float]]:
    """Return the loss of even and of odd rows at each displacement of a rendering within a resolution cell, nats."""
    reach = [math.ceil(length / spacing) for length, spacing in zip(grid.resolution_m, grid.spacing_m, strict=True)]
    steps = [np.unique(np.linspace(-far, far, 5).round().astype(int)) for far in reach]
    inside = np.s_[reach[1] : -reach[1], reach[0] : -reach[0]]
    losses = []
    for places in itertools.product(steps[1], steps[0]):
        moved = np.roll(expected, places, (0, 1))[inside]
        rows = (np.log(moved) + image[inside] / moved).mean(axis=1)
        losses.append((float(rows[::2].mean()), float(rows[1::2].mean())))
    return [list(part) for part in zip(*losses, strict=True)]
