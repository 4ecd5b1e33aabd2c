"""Decibels, amplitudes and conversions of β⁰, against closed forms."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch

import sarsplat
from sarsplat import radiometry
from sarsplat.cli.render import Pictures

POWER = np.array([1.0, 10.0, 0.5])


def test_decibels_of_power() -> None:
    np.testing.assert_allclose(radiometry.to_db(POWER, 10.0), [-10, 0, -13.0103], atol=1e-4)
    np.testing.assert_allclose(radiometry.from_db(radiometry.to_db(POWER)), POWER, rtol=1e-14)
    assert radiometry.to_db(0.0) == pytest.approx(-379.3, abs=0.1)
    assert radiometry.to_db(np.float32(0.001)) == pytest.approx(-30)
    assert radiometry.to_db(0.0, least=0.0) == -np.inf
    np.testing.assert_allclose(radiometry.amplitude(POWER) ** 2, POWER)


@pytest.mark.parametrize("grazing_deg", [10.0, 45.0, 80.0])
def test_flat_ground(grazing_deg: float) -> None:
    """σ⁰ counts area on the ground, β⁰ in the slant plane, γ⁰ across the line of sight: one scatterer, three areas."""
    ground, slant = 7.0, 7.0 * math.cos(math.radians(grazing_deg))
    across = 7.0 * math.sin(math.radians(grazing_deg))
    beta0, sigma0, gamma0 = 3.0 / slant, 3.0 / ground, 3.0 / across
    assert radiometry.beta0_of_gamma0(gamma0, grazing_deg) == pytest.approx(beta0)
    assert radiometry.gamma0_of_beta0(beta0, grazing_deg) == pytest.approx(gamma0)
    assert radiometry.beta0_of_sigma0(sigma0, grazing_deg) == pytest.approx(beta0)
    assert radiometry.sigma0_of_beta0(beta0, grazing_deg) == pytest.approx(sigma0)
    tensor = torch.tensor([gamma0], requires_grad=True)
    radiometry.beta0_of_gamma0(tensor, grazing_deg).backward()
    assert tensor.grad.item() == pytest.approx(beta0 / gamma0)


def test_the_bright_level_ignores_a_glint_and_is_never_zero() -> None:
    power = np.ones((50, 50))
    power[0, 0] = 1e6
    assert radiometry.bright_level(power) == 1.0
    lone = np.zeros((50, 50))
    lone[0, 0] = 4.0
    assert radiometry.bright_level(lone) == 4.0
    assert radiometry.bright_level(np.zeros((2, 2))) == 1.0


@pytest.mark.parametrize("db", [20, 30, 40])
def test_the_usual_peak_is_the_largest_power_but_for_few_echoes_that_outshine_all_others(db: int) -> None:
    target = np.exp(np.random.default_rng(0).normal(0, 1.5, 3000))
    image = np.zeros((100, 100))
    image.flat[: len(target)] = target
    assert radiometry.usual_peak(image) == image.max()  # 19 dB above its upper quartile
    image.flat[5000:5100] = 10 ** (db / 10) * image.max() * np.exp(-np.linspace(0, 14, 100))  # with its skirts
    assert 1 <= radiometry.usual_peak(image) / target.max() < 3
    assert radiometry.usual_peak(np.pad(image, 300)) == radiometry.usual_peak(image)  # of any size
    assert radiometry.usual_peak(np.zeros(3)) == 0
    assert radiometry.usual_peak(np.eye(5)) == 1


def test_white_is_the_largest_power_unless_it_outshines_all() -> None:
    image = np.geomspace(1.0, 30.0, 10000)
    assert radiometry.white_level(image) == image.max()
    image[:9] = 1e6
    assert radiometry.white_level(image) == 100 * radiometry.bright_level(image) < 3001
    assert [radiometry.white_level(np.zeros(n)) for n in (0, 3)] == [1, 1]
    alone = np.zeros((128, 128))
    alone[5, 5:27] = np.geomspace(1.0, 1e-3, 22)  # a scatterer and its response, on nothing
    assert radiometry.white_level(alone) == 1
    alone[90, 90] = 1e6
    assert radiometry.white_level(alone) < 100


def test_brightness_is_linear_in_decibels() -> None:
    np.testing.assert_allclose(radiometry.shade(np.array([200.0, 100.0, 1.0, 0.0]), 100.0), [1, 1, 0.5, 0])
    np.testing.assert_allclose(radiometry.shade(np.array([1.0]), 100.0, 25.0), [0.2])
    assert radiometry.brighter(np.array([1.0, 0.11, 0.1]), -10.0).tolist() == [True, True, False]
    assert radiometry.brighter(np.array([1.0, 0.11, 0.1]), -10.0, 10.0).tolist() == [False, False, False]


def test_what_is_darker_than_the_darkest_makes_no_difference() -> None:
    rendered, truth = np.array([2.0, 1e-9, 1.0]), np.array([1.0, 1e-6, 0.0])
    np.testing.assert_allclose(radiometry.difference_db(rendered, truth, 10.0, -30.0), [3.0103, 0, 20], atol=1e-4)


def test_there_is_one_dynamic_range() -> None:
    """The command's own default is written there: its options are read without numpy."""
    assert Pictures.range_db == radiometry.DYNAMIC_RANGE_DB


def test_decibels_are_computed_nowhere_else() -> None:
    package = Path(sarsplat.__file__).parent
    pattern = re.compile(r"10(\.0)? ?\* ?(np|math|torch)\.log10|\*\* ?\(.*/ 10\)")
    own = [path for path in package.rglob("*.py") if path.name != "radiometry.py" and pattern.search(path.read_text())]
    assert not own
