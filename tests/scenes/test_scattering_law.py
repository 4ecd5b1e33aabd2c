import math

import numpy as np
import pytest

from sarsplat.errors import SarsplatError
from sarsplat.scenes import ScatteringLaw


def test_law_is_floor_plus_lobe_and_two_sided():
    law = ScatteringLaw(0.1, 0.9)
    cosines = np.array([1.0, -1.0, 0.5, -0.5, 0.0])
    np.testing.assert_allclose(law.gamma0(cosines), [1.0, 1.0, 0.325, 0.325, 0.1])


def test_law_can_be_recorded_and_restored():
    law = ScatteringLaw(0.02, 3.0)
    assert law.as_dict() == {"floor": 0.02, "lobe": 3.0}
    assert ScatteringLaw(**law.as_dict()) == law


@pytest.mark.parametrize("coefficients", [{"floor": -0.1}, {"lobe": math.nan}, {"lobe": math.inf}])
def test_impossible_coefficients_are_refused(coefficients):
    with pytest.raises(SarsplatError, match=next(iter(coefficients))):
        ScatteringLaw(**coefficients)
