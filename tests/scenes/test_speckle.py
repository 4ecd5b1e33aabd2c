import math

import numpy as np
import pytest

from sarsplat.errors import SarsplatError
from sarsplat.scenes import add_speckle


@pytest.mark.parametrize("looks", [1, 4, 2.5])
def test_speckle_keeps_the_mean_and_has_variance_one_over_looks(looks):
    power = np.full((400, 400), 3.0, dtype=np.float32)
    speckled = add_speckle(power, looks, np.random.default_rng(0))
    assert speckled.dtype == np.float32 and speckled.shape == power.shape
    assert speckled.mean() == pytest.approx(3.0, rel=0.02)
    assert speckled.var() == pytest.approx(9.0 / looks, rel=0.04)


def test_speckle_is_multiplicative_and_reproducible():
    power = np.array([[0.0, 1.0], [2.0, 5.0]])
    speckled = add_speckle(power, 1, np.random.default_rng(3))
    assert speckled[0, 0] == 0
    np.testing.assert_array_equal(speckled, add_speckle(power, 1, np.random.default_rng(3)))
    np.testing.assert_allclose(add_speckle(10 * power, 1, np.random.default_rng(3)), 10 * speckled)


@pytest.mark.parametrize("looks", [0, -1, math.nan, math.inf])
def test_impossible_looks_are_refused(looks):
    with pytest.raises(SarsplatError, match=f"looks {looks} must be positive and finite"):
        add_speckle(np.ones((2, 2)), looks, np.random.default_rng(0))
