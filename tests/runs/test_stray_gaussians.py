"""Gaussians that lie apart or are far larger, as a loop of one's own may leave them."""

import pytest
import torch

from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.runs.own_gaussians import usual_grid, without_strays
from upright import upright

PLACES = torch.rand(60, 3, generator=torch.Generator().manual_seed(0))


def test_a_stray_does_not_set_the_grid_and_is_said():
    whole = upright(PLACES)
    far = PLACES.clone()
    far[7, 1] = 900.0
    with pytest.warns(
        SarsplatWarning, match=r"1 of 60 Gaussians lies apart .*: up to 90\d m from the origin, 1.\d % of"
    ):
        grid = usual_grid(upright(far))
    assert grid.spacing_m[0] == pytest.approx(usual_grid(whole).spacing_m[0], rel=0.1)
    rest, said = without_strays(upright(far))
    assert len(rest) == 59 and said.startswith("1 of 60 Gaussians")
    assert without_strays(whole)[1] == ""


def test_a_scene_that_no_image_can_show_is_refused_by_its_size():
    with pytest.raises(SarsplatError, match=r"the Gaussians reach .* m from the origin, farther than any image shows"):
        usual_grid(upright(PLACES[:1] * 0, 1e13))
