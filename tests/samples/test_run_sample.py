"""Single images of a run: they differ as the training images did, are on average what is expected, or are refused."""

import math
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.special import digamma

from made import upright
from sarsplat import Run, SarsplatError, View, chips
from sarsplat.learning.method import DrawsSamples, Reconstruction
from sarsplat.learning.model import SceneModel
from sarsplat.learning.parts.part import Shot, drawn_like
from sarsplat.learning.sampler import Sampler
from sarsplat.names import Speckle
from sarsplat.samples import backdrop_of, write_chips

VIEW = View(40.0, 17.0)


def drawn(draw: DrawsSamples, count: int) -> np.ndarray:
    """Power of samples."""
    return np.stack([np.abs(draw(VIEW, seed)) ** 2 for seed in range(count)])


def of_power(
    run: Run, count: int, ground: str = "learned", speckle: Speckle = "response", scatterers: float = math.inf
) -> np.ndarray:
    return drawn(run.reconstruction.sampler(backdrop_of(ground, run.grid), speckle, scatterers), count)


def test_view_and_seed_say_all(run: Run) -> None:
    one = run.sample(VIEW, 7)
    assert (one.dtype, one.shape) == (np.complex64, (32, 36))
    assert np.array_equal(one, run.sample(VIEW, 7))
    assert not np.isclose(run.sample(VIEW, 8), one, rtol=1e-3).any()
    assert not np.array_equal(run.sample(View(41.0, 17.0), 7), one)


@pytest.mark.parametrize("scatterers", [math.inf, 2.5])
def test_on_average_it_is_what_is_rendered(run: Run, scatterers: float) -> None:
    """Over patches, for the response of the mean image is widened."""
    mean, expected = of_power(run, 60, scatterers=scatterers).mean(0), run.render([VIEW])[0]
    patches = [image.reshape(4, 8, 4, 9).mean((1, 3)) for image in (mean, expected)]
    assert patches[0] == pytest.approx(patches[1], rel=0.15)


def test_speckle_has_the_power_of_what_it_is_on(run: Run) -> None:
    clean = of_power(run, 40, speckle="none")
    kinds: tuple[Speckle, ...] = "response", "white"
    for speckle in kinds:
        ratio = of_power(run, 40, speckle=speckle) / clean
        assert ratio.mean() == pytest.approx(1, abs=0.03)
        assert ratio.std() == pytest.approx(1, abs=0.05)


def altered(run: Run, **factors: float) -> SceneModel:
    """The run's model with its target's sizes and depths multiplied, and of another γ⁰."""
    assert run.model is not None
    model, scene = copy(run.model), run.model.target(0)
    changed = {name: getattr(scene, name) * factor for name, factor in factors.items() if name != "scattering"}
    if "scattering" in factors:
        none = torch.full_like(scene.scattering.parameters, -100.0)
        changed["scattering"] = replace(scene.scattering, parameters=none, p_min=factors["scattering"])
    model.target = lambda degree: replace(scene, **changed)  # type: ignore[method-assign]
    return model


def powers(model: SceneModel, run: Run, count: int, speckle: Speckle, scatterers: float) -> np.ndarray:
    return drawn(Sampler(model, 0, run.grid, "learned", speckle, scatterers), count)


def mean_drawn_from(power: np.ndarray, run: Run, count: int) -> np.ndarray:
    """Mean power of samples of which the target's expectation is given, and nothing else is there."""
    assert run.model is not None
    draw = Sampler(run.model, 0, run.grid, "learned", "response", math.inf)
    draw._powers = lambda *_: (power, np.zeros_like(power))  # type: ignore[method-assign]
    return drawn(draw, count).mean(0)


def test_few_scatterers_put_a_targets_power_into_points_and_leave_the_ground_alone(run: Run) -> None:
    """The mean logarithm is ψ(ν) − log ν − γ in a K-distribution; of the ground it is −γ, as in all speckle."""
    bright = altered(run, scattering=60.0)
    clean = powers(bright, run, 100, "none", math.inf)
    target = clean.mean(0) > 0.5 * clean.mean(0).max()
    for few in (math.inf, 1.0):
        logarithm = np.log(powers(bright, run, 100, "response", few) / clean)
        assert logarithm[:, :4].mean() == pytest.approx(-np.euler_gamma, abs=0.06)
        spread = 0.0 if few == math.inf else digamma(few) - math.log(few)
        assert logarithm[:, target].mean() == pytest.approx(spread - np.euler_gamma, abs=0.25)


def test_noise_and_brighter_ground_before_a_target_are_speckle(run: Run) -> None:
    """Where the target is faint against either, there is nothing of its few scatterers."""
    faint, grid = altered(run, scattering=1e-4, optical_depth=30.0), run.grid
    for ground in ("learned", 100 * np.ones((grid.rows, grid.columns), np.float32)):
        draws = [Sampler(faint, 0, grid, ground, "response", scatterers) for scatterers in (math.inf, 0.3)]
        levels = [np.log(drawn(draw, 50)).mean(0) for draw in draws]
        off = (levels[0] - levels[1])[10:24, 12:22].reshape(7, 2, 5, 2).mean((1, 3))  # and in its shadow
        assert np.abs(off).mean() < 0.18  # chance makes 0.13


def test_gaussians_smaller_than_pixels_keep_their_power(run: Run) -> None:
    """They are imaged in finer pixels."""
    small = altered(run, scales=1 / 6, scattering=300.0)
    clean, speckled = (powers(small, run, 20, speckle, 2.5)[:, 6:26, 8:28] for speckle in ("none", "response"))
    assert speckled.mean() == pytest.approx(clean.mean(), rel=0.1)


@pytest.mark.parametrize(("row", "column"), [(0, 18), (31, 18), (16, 0), (16, 35)])
def test_what_is_at_one_edge_is_not_seen_at_the_opposite_one(run: Run, row: int, column: int) -> None:
    """As on a grid that goes on beyond both: the response of a bright point ends there, side lobes included."""
    point = np.zeros((32, 36), np.float32)
    point[row, column] = 1
    seen = mean_drawn_from(point, run, 20)
    opposite = seen[31 - row] if column == 18 else seen[:, 35 - column]
    assert np.unravel_index(seen.argmax(), seen.shape) == (row, column)
    assert opposite.max() < seen.max() / 255**2


def test_nothing_darkens_towards_the_edges(run: Run) -> None:
    seen = mean_drawn_from(np.full((32, 36), 3.0, np.float32), run, 200)
    for edge in (seen[0], seen[-1], seen[:, 0], seen[:, -1]):
        assert edge.mean() == pytest.approx(3, rel=0.06)


def test_gains_and_shifts_are_drawn_as_they_were_found(run: Run) -> None:
    """Gains by e^±0.4 and shifts by ±0.1 m, as the fixture has it."""
    rng, model = np.random.default_rng(0), run.model
    assert model is not None
    shots = [model.shot([VIEW] * 500, run.grid, rng=rng) for _ in range(4)]
    gains = torch.cat([shot.gain for shot in shots]).log()
    assert float(gains.std()) == pytest.approx(0.4, rel=0.05)
    assert float(gains.mean()) == pytest.approx(-np.log(np.cosh(0.4)), abs=0.03)  # of factors with the mean 1
    shifts = torch.cat([shot.shift for shot in shots])
    assert shifts.mean(0).tolist() == pytest.approx([0.2, 0.0], abs=0.01)
    assert shifts.std(0).tolist() == pytest.approx([0.1, 0.1], rel=0.05)
    assert all(shot.grid == run.grid for shot in shots[:3])  # not widened


def test_a_gain_is_on_what_is_scattered_and_not_on_the_noise(run: Run) -> None:
    model = run.model
    assert model is not None
    black = torch.zeros(2, 1, 32, 36)
    shot = Shot([VIEW] * 2, run.grid, 0, None, np.random.default_rng(0), gain=torch.tensor([0.5, 4.0]))
    floor = model.developed(black, shot, estimated=False)
    assert torch.equal(floor[0], floor[1])
    assert floor.min() > 0
    lit = (model.developed(black + 1, shot, estimated=False) - floor).detach()
    assert float((lit[1] / lit[0]).mean()) == pytest.approx(8)


def test_one_image_has_no_spread() -> None:
    found = drawn_like(torch.tensor([[3.0, 4.0]]), 2, np.random.default_rng(0))
    assert found.tolist() == [[3.0, 4.0]] * 2


def test_uniform_ground_is_everywhere_the_same(run: Run) -> None:
    model = run.model
    assert model is not None
    texture = model.parameters["ground_texture"]
    before = texture.detach().clone()
    with torch.no_grad():
        texture.copy_(torch.randn(texture.shape, generator=torch.Generator().manual_seed(0)))
    try:
        around = slice(0, 6)  # near range: ground alone
        learned, uniform = (of_power(run, 1, ground=one, speckle="none")[0][around] for one in ("learned", "uniform"))
    finally:
        with torch.no_grad():
            texture.copy_(before)
    assert learned.std() / learned.mean() > 0.3
    assert uniform.std() / uniform.mean() < 0.05
    assert 0.3 < uniform.mean() / learned.mean() < 3


def test_ground_as_a_picture_shows_it(run: Run, tmp_path: Path) -> None:
    picture = np.full((64, 36), 40, np.uint8)
    picture[32:] = 80  # four times the power
    Image.fromarray(picture).save(tmp_path / "ground.png")
    near = of_power(run, 40, ground=str(tmp_path / "ground.png"), speckle="none")[:, :4].mean((1, 2))
    assert near.max() / near.min() > 2.5  # some of its bright part, some of its dark one
    again = of_power(run, 2, ground=str(tmp_path / "ground.png"), speckle="none")[:, :4].mean((1, 2))
    assert again.tolist() == near[:2].tolist()
    Image.fromarray(picture[:20]).save(tmp_path / "small.png")
    Image.fromarray(picture * 0).save(tmp_path / "black.png")
    for name, words in (("small", "at least 32 × 36 pixels"), ("black", "is black"), ("none", "does not exist")):
        with pytest.raises(SarsplatError, match=words):
            run.sample(VIEW, ground=backdrop_of(tmp_path / f"{name}.png", run.grid))


# ---- samples that cannot be had --------------------------------------------------------------------------------------
SETS: list[tuple[dict[str, Any], str]] = [
    *(({"count": count}, f"count is {count}; give 1 to 100000000 chips") for count in (0, 10**20)),
    ({"azimuths_deg": [float("inf")]}, "azimuth inf is not a number between"),
    ({"grazing_deg": (20.0, 10.0)}, "grazing 20:10 goes down; give the lower"),
    ({"grazing_deg": (0.0, 10.0)}, "grazing angle 0.0° is outside"),
    ({"crop": 33}, "crop is 33, but the images of the runs have 32 × 36 pixels; give at most 32"),
    ({"crop": 0}, "crop is 0; give at least one"),
    ({"quantity": "phase"}, "quantity is 'phase'; give one of 'magnitude', 'power', 'complex'"),
    ({"scale": "calibrated", "format": "png"}, "scale is 'calibrated', which the 8 bits of png cannot hold"),
    ({"jpeg_quality": 101}, "jpeg_quality is 101; give 1 to 100"),
    ({"ground": "Uniform"}, "ground is 'Uniform'; give learned, uniform or the file of a picture"),
]
SINGLE: list[tuple[dict[str, Any], str]] = [
    ({"seed": -1}, "seed.* -1"),
    ({"speckle": "grey"}, "speckle is 'grey'; give one of 'response', 'white', 'none'"),
    ({"ground": "lerned"}, "ground is 'lerned'; give learned, uniform, or its power"),
    *(
        ({"ground": np.full((64, 36), bad, np.float32)}, r"is \[64, 36\] numbers, .*; give power")
        for bad in (math.nan, math.inf, -1.0)
    ),
    *(({"scatterers": few}, r"scatterers is .*; give a number above 0, or inf") for few in (0.0, -1.0, math.nan)),
]


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        *((lambda run, options=options: chips([run], **options), words) for options, words in SETS),
        *((lambda run, options=options: run.sample(View(40, 17), **options), words) for options, words in SINGLE),
        (lambda run: chips([]), "there are no runs"),
        (lambda run: write_chips(chips([run], count=1), "out", shard=0), "shard is 0; give at least one"),
        (lambda run: Run.from_gaussians(upright([0, 0, 0])).sample(View(40, 17)), "was learned without speckle"),
        (lambda run: Reconstruction.sampler(run, "learned", "response", 1.0), "not how single ones differ"),
    ],
)
def test_what_is_refused(run: Run, ask, words, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SarsplatError, match=words):
        ask(run)
    assert not list(tmp_path.iterdir())
