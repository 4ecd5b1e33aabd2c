"""The law of scattering that all Gaussians of a training have in common is learned from the images."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch

from made import dataset_of
from sarsplat import Dataset, NormalLobes, Run, SarsplatError, ScatteringLaw, View, reconstruct, simulate_raycast
from sarsplat.gaussians import SCATTERINGS, register_scattering
from sarsplat.learning import Trainer
from sarsplat.settings import Config

VIEWS = [View(azimuth, grazing) for azimuth in range(0, 360, 45) for grazing in (20.0, 45.0, 70.0)]


def seen(dataset: Dataset, exponent: float) -> Dataset:
    """A slanted box whose γ⁰ follows that power of the cosine."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    mesh = trimesh.creation.box((3.0, 2.0, 1.2))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.3, (1, 1, 0)))
    mesh.apply_translation([0, 0, 1.2])
    law = ScatteringLaw(0.1, 0.9, exponent)
    images = np.stack([simulate_raycast(mesh, view, dataset.grid, law) for view in VIEWS])
    return dataset_of(dataset.grid, [(view, "train") for view in VIEWS], images, source={"kind": "raycast"})


def exponents(run: Run) -> torch.Tensor:
    law = run.gaussians.scattering
    assert isinstance(law, NormalLobes)
    return law.parameters[:, 2].exp()


def test_the_exponent_follows_the_images_and_is_one_for_all(dataset: Dataset, config: Config) -> None:
    longer = replace(config, iterations=130)
    narrow, wide = (exponents(reconstruct(seen(dataset, e), longer, quiet=True)) for e in (8.0, 2.0))
    assert narrow.unique().numel() == wide.unique().numel() == 1
    assert narrow[0] > 4.5
    assert 1.4 < wide[0] < 3.5


def test_a_heavy_penalty_keeps_it(dataset: Dataset, config: Config) -> None:
    kept = exponents(reconstruct(seen(dataset, 8.0), replace(config, law_penalty=100.0), quiet=True))
    assert float(kept[0]) == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("loss", ["speckle", "amplitude"])
def test_penalties_are_in_nats_beside_a_likelihood(dataset: Dataset, config: Config, loss: str) -> None:
    """Otherwise in units of the loss of black images."""
    trainer = Trainer(dataset, replace(config, loss=loss))
    with torch.no_grad():
        trainer.model.parameters["scattering"][::2] += 1.0
    expected = {name: value.item() for name, value in trainer.model.penalties().items()}
    trainer.step()
    found = {name: trainer.terms[name].item() for name in expected}
    assert expected["scattering penalty"] > 0
    if loss == "speckle":
        assert found == pytest.approx(expected, rel=1e-6)
    else:
        assert found["scattering penalty"] < 0.1 * expected["scattering penalty"]


@dataclass(frozen=True)
class Tuned(NormalLobes):
    """Two numbers in common, within ranges of their own."""

    kind: ClassVar[str] = "tuned"
    common: ClassVar[tuple[tuple[float, float], ...]] = ((-0.01, 0.01), (0.0, math.log(32)))


@pytest.fixture
def tuned(monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(SCATTERINGS, "_entries", dict(SCATTERINGS._entries))  # for this test alone
    register_scattering(Tuned)
    return Tuned.kind


def test_laws_of_ones_own_share_what_they_say(dataset: Dataset, config: Config, tuned: str, tmp_path: Path) -> None:
    made = reconstruct(dataset, replace(config, scattering=tuned), tmp_path / "run", quiet=True)
    parameters = made.gaussians.scattering.parameters
    assert parameters[:, 0].unique().numel() > 1
    assert parameters[:, 1].unique().numel() == parameters[:, 2].unique().numel() == 1
    assert abs(float(parameters[0, 1])) <= 0.01
    assert torch.equal(Run.load(tmp_path / "run").gaussians.scattering.parameters, parameters)


def test_a_law_with_nothing_for_each_gaussian(
    dataset: Dataset, config: Config, tuned: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Tuned, "common", ((0.0, 1.0),) * 3)
    with pytest.raises(SarsplatError, match="with K above the 3 ranges of Tuned"):
        reconstruct(dataset, replace(config, scattering=tuned), quiet=True)


def test_each_gaussian_has_an_exponent_of_its_own_if_asked_for(dataset: Dataset, config: Config) -> None:
    found = exponents(reconstruct(dataset, replace(config, common_law=False), quiet=True))
    assert found.unique().numel() > 100
