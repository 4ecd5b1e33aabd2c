"""Trainings are float32 whatever torch makes by default in the program around them."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from made import small_dataset
from made_runs import made_up
from sarsplat import Run, preset, reconstruct
from sarsplat.learning.parts.target import dropped
from sarsplat.runs.methods import method_named


@pytest.fixture
def doubles() -> Iterator[None]:
    yield
    torch.set_default_dtype(torch.float32)


def of_preset() -> Run:
    return reconstruct(small_dataset(), replace(preset("default"), iterations=12, gaussians=60), quiet=True)


def of_grid() -> Run:
    config = method_named("sar-nerf-grid").settings.from_dict({"iterations": 2}, "the test")
    return reconstruct(small_dataset(), config, method="sar-nerf-grid", quiet=True)


@pytest.mark.parametrize("share", [1e-3, 0.15, 0.4, 0.9])
def test_the_same_are_dropped(share: float, doubles: None) -> None:
    usual = dropped(200_000, share, 3, 7, torch.device("cpu"))
    torch.set_default_dtype(torch.bfloat16)
    assert torch.equal(dropped(200_000, share, 3, 7, torch.device("cpu")), usual)
    assert float(usual.sum()) == pytest.approx(share * len(usual), rel=0.2)


@pytest.mark.filterwarnings("ignore:.*cannot determine the shape", "ignore:.*are constant")
@pytest.mark.parametrize("trained", [of_preset, lambda: made_up("T72"), of_grid], ids=["default", "measured", "grid"])
def test_the_default_of_torch_changes_no_bit(trained, doubles) -> None:
    usual = trained().snapshot.tensors
    torch.set_default_dtype(torch.float64)
    other = trained().snapshot.tensors
    assert {name: tensor.dtype for name, tensor in other.items()} == {n: t.dtype for n, t in usual.items()}
    assert [name for name, tensor in usual.items() if not torch.equal(tensor, other[name])] == []
