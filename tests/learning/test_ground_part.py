"""Ground and law of a model are those of the images: level, texture, second bounce, and the law of scattering."""

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch

from made import FEW_POINTS, dataset_of, hill, upright
from made_runs import assert_same, trained
from sarsplat import Run, SarsplatError, ScatteringLaw, Trainer, View, preset, reconstruct, render, simulate_raycast
from sarsplat.data import Dataset
from sarsplat.gaussians import SCATTERINGS, Ground, Harmonics, NormalLobes, register_scattering
from sarsplat.geometry import ImageGrid, RayGrid, Terrain
from sarsplat.learning.method import Inputs
from sarsplat.learning.model import SceneModel
from sarsplat.learning.observations.single_images import PartsOfImages, SingleImages
from sarsplat.learning.observations.stacks import Stacks
from sarsplat.learning.snapshot import Snapshot
from sarsplat.radar import Pixel
from sarsplat.renderer import GroundBounce
from sarsplat.report.page import _run_facts
from sarsplat.settings import Config
from sarsplat.settings.sections import Bounce, FlatGround
from sarsplat.viewer.subject import training_subject

GRID = ImageGrid(48, 48, (0.3, 0.3), (0.3, 0.3))
SHORT = replace(preset("default"), iterations=100, gaussians=150, ground=FlatGround())


UNEVEN = [View(60.0 * k, (25.0, 40.0, 60.0)[k % 3]) for k in range(6)]
LEVEL = [View(60.0 * k, 35.0) for k in range(6)]


def places(height_m: float) -> np.ndarray:
    """Of Gaussians that fill a block of 2 × 1 m."""
    steps = [np.arange(low, high, 0.2) + 0.1 for low, high in ((-1, 1), (-0.5, 0.5), (0, height_m))]
    return np.stack(np.meshgrid(*steps), -1).reshape(-1, 3)


def seen(views: list[View], ground: Ground) -> Dataset:
    """Something opaque of 2 × 1 × 1 m."""
    block = upright(places(1.0), 0.1, 2.0, Harmonics(torch.zeros(250, 1), 0.3))
    with torch.no_grad():
        images = render(block, views, GRID, ground=ground).channel(0).numpy()
    return dataset_of(GRID, [(view, "train") for view in views], images, ground=True)


def test_level_and_law_are_learned() -> None:
    dataset = seen(UNEVEN, Ground(torch.tensor(0.2), exponent=torch.tensor(0.8)))
    trainer = trained(dataset, replace(SHORT, iterations=150), 150)
    ground = trainer.model.ground()
    assert float(ground.exponent.detach()) == pytest.approx(0.8, abs=0.1)
    assert float(ground.gamma0.detach().median()) == pytest.approx(0.2, rel=0.05)
    assert float(trainer.gaussians.means[:, 2].min()) >= 0  # nothing of the target is below the ground


def test_a_run_says_what_it_learned_of_the_ground() -> None:
    """In the unit of the images, which chips without calibration choose as they like."""
    dataset = seen(UNEVEN, Ground(torch.tensor(2e3)))
    facts = reconstruct(dataset, replace(SHORT, iterations=60, points=FEW_POINTS), quiet=True).facts
    match = re.fullmatch(r"a plane, γ⁰ (\S+) \(linear\)", facts["ground"])
    assert match
    assert float(match[1]) == pytest.approx(2e3, rel=0.1)


def test_a_run_says_where_it_looked_for_the_target_and_that_its_ground_was_terrain() -> None:
    """What stands outside of the box is not in the result, and nothing else says so."""
    dataset = seen(LEVEL, Ground(torch.tensor(0.2)))
    dataset = replace(dataset, target_box_m=((-2, -1, 0), (2.5, 1, 2)))
    flat = reconstruct(dataset, replace(SHORT, iterations=1), quiet=True).facts
    assert flat["looked in"] == "x -2 … 2.5, y -1 … 1, z 0 … 2 m (--target-box gives another)"
    hilly = replace(dataset, terrain=Terrain(np.zeros((60, 60), np.float32), (0.5, 0.5)))
    facts = reconstruct(hilly, replace(SHORT, iterations=1), quiet=True).facts
    assert "z 0 … 2 m above the terrain" in facts["looked in"]
    assert facts["ground"].startswith("terrain, γ⁰ ")


def test_texture_is_learned_where_it_is() -> None:
    """Twice as bright where y > 0."""
    table = torch.full((41, 41), 0.1)
    table[21:] = 0.2
    trainer = trained(seen(LEVEL, Ground(table, 0.5)), SHORT, 100)
    assert trainer.learning_rates["ground_exponent"] == 0  # one angle says nothing of others
    ground = trainer.model.ground()
    gamma0, middle = ground.gamma0.detach(), (len(ground.gamma0) - 1) // 2
    apart = round(3 / ground.pitch_m)
    assert float(gamma0[middle + apart, middle]) == pytest.approx(0.2, rel=0.1)
    assert float(gamma0[middle - apart, middle]) == pytest.approx(0.1, rel=0.1)


def test_places_are_as_far_apart_as_cells_and_scene_say() -> None:
    dataset = seen(LEVEL[:3], Ground(torch.tensor(0.2)))
    pitch_m = [
        Trainer(dataset, replace(SHORT, ground=FlatGround(pitch=pitch))).model.ground().pitch_m for pitch in (2.0, 5.0)
    ]
    assert pitch_m == pytest.approx([0.6, 1.5])
    assert Trainer(dataset, replace(SHORT, ground=FlatGround(pitch=0))).model.ground().gamma0.ndim == 0
    radius_m = 12.0  # about
    dense = Trainer(dataset, replace(SHORT, ground=FlatGround(pitch=0.01))).model.ground()
    assert len(dense.gamma0) <= 515
    assert dense.pitch_m == pytest.approx(2 * radius_m / 512, rel=0.2)


# ---- the second bounce by way of the ground --------------------------------------------------------------------------
FINE = ImageGrid(36, 36, (0.3, 0.3), (0.3, 0.3))
VIEWS = [View(45.0 * k + 10.0, (20.0, 40.0, 60.0)[k % 3]) for k in range(8)]
BOUNCING = replace(
    preset("default"),
    iterations=120,
    gaussians=150,
    coarsest=1,
    harmonics_every=10,
    points=FEW_POINTS,
    ground=FlatGround(pitch=0.0),
    bounce=Bounce(),
)


def mirrored_by(reflectivity: float) -> Dataset:
    """A block of 2 × 1 × 1.2 m with a mirror below."""
    block = upright(places(1.2), [0.1, 0.11, 0.12], 2.0, NormalLobes.initial(300, 0.5, 0.05))
    ground = Ground(torch.tensor(0.05))
    with torch.no_grad():
        bounce = GroundBounce(ground, torch.tensor(reflectivity))
        images = render(block, VIEWS, FINE, ground=ground, echoes=[bounce]).channel(0).numpy()
    return dataset_of(FINE, [(view, "train") for view in VIEWS], images, ground=True)


@pytest.fixture(scope="module")
def mirrored() -> Dataset:
    return mirrored_by(0.8)


def reflectivity(model: SceneModel) -> float:
    return float(model.parameters["ground_reflectivity"].detach())


def test_how_much_is_reflected_follows_the_images_once_there_is_a_shape(mirrored: Dataset) -> None:
    quick = replace(BOUNCING, iterations=80, law_from=0.5, rates=replace(BOUNCING.rates, nuisance=0.03))
    bare, mirror = (trained(dataset, quick, 80).model for dataset in (mirrored_by(0.0), mirrored))
    assert reflectivity(bare) < 0.1
    assert reflectivity(mirror) > 0.4
    assert reflectivity(trained(mirrored, replace(quick, iterations=15, law_from=1.0), 15).model) == pytest.approx(0.3)
    shares = mirror.power_by_echo(3)
    assert sum(shares.values()) == pytest.approx(1.0)
    assert list(shares) == ["target", "ground", "by way of the ground"]
    assert 0.05 < shares["by way of the ground"] < 0.5


def test_runs_keep_it_and_go_on_with_the_same_bits(mirrored: Dataset, tmp_path: Path) -> None:
    short = replace(BOUNCING, iterations=15, law_from=0.0)
    trained(mirrored, short, 6).snapshot(0.0).save(tmp_path / "checkpoint")
    resumed = trained(mirrored, short, 3, Snapshot.load(tmp_path / "checkpoint"))
    assert_same(trained(mirrored, short, 9).snapshot(0.0), resumed.snapshot(0.0))
    whole = reconstruct(mirrored, short, out=tmp_path / "whole", quiet=True)
    kept = Run.load(tmp_path / "whole")
    images = kept.render(VIEWS[:1])
    assert np.array_equal(images, whole.render(VIEWS[:1]))
    assert kept.model is not None
    assert reflectivity(kept.model) != pytest.approx(0.3)
    assert kept.facts["second bounce"].endswith(f"reflects {reflectivity(kept.model):.3g} of the power")
    assert _run_facts(kept)["power"].startswith("target ")
    model, rays = kept.model, RayGrid.for_image(FINE, 4.0)  # those of a run's images
    with torch.no_grad():
        direct = render(model.target(3), VIEWS[:1], FINE, rays=rays, ground=model.ground())
        bounced = render(model.target(3), VIEWS[:1], FINE, rays=rays, ground=model.ground(), echoes=model.echoes())
    assert np.allclose(bounced.channel(0).numpy(), images, rtol=1e-5)
    assert images.sum() > direct.channel(0).sum() * 1.01


def test_samples_have_it(mirrored: Dataset) -> None:
    run = reconstruct(mirrored, replace(BOUNCING, iterations=40, loss="speckle"), quiet=True)
    sample = np.abs(run.sample(VIEWS[0], seed=0, speckle="none")) ** 2
    assert np.allclose(sample, run.render(VIEWS[:1])[0], rtol=0.05, atol=1e-3 * sample.max())
    assert run.model is not None
    with torch.no_grad():
        without = render(run.model.target(3), VIEWS[:1], FINE, ground=run.model.ground()).channel(0)
    assert sample.sum() > float(without.sum()) * 1.01


def test_the_viewer_tells_whose_foot_is_in_a_pixel(mirrored: Dataset) -> None:
    trainer = trained(mirrored, replace(BOUNCING, iterations=60), 60)
    subject, model = training_subject(mirrored, trainer), trainer.model
    with torch.no_grad():
        echoes = render(model.target(3), VIEWS[:1], FINE, ground=model.ground(), echoes=model.echoes()).echoes
    _, (bounced,) = echoes
    row, column = np.unravel_index(int(bounced.argmax()), bounced.shape)
    found = subject.contributors(VIEWS[0], Pixel(int(row), int(column)))
    assert found is not None
    assert 0.1 < found.by_ground_share < 1
    assert np.array_equal(subject.render(VIEWS[0], ground=False), subject.render(VIEWS[0], ground=False, shadow=False))


def test_what_it_cannot_be_combined_with_is_refused(mirrored: Dataset) -> None:
    with pytest.raises(SarsplatError, match="bounce is on, but needs ground, which is off; switch ground on"):
        replace(BOUNCING, ground=None)
    assert Stacks.goes_with["ground"] is None  # without which there is no bounce
    with pytest.raises(SarsplatError, match="bounce is on, which needs level ground"):
        SingleImages.refuse(BOUNCING, replace(mirrored, terrain=hill()), Inputs())
    with pytest.raises(SarsplatError, match="bounce is on, which cannot be combined with tiles 2; give off, or"):
        PartsOfImages.refuse(replace(BOUNCING, tiles=2), mirrored, Inputs())


# ---- the law of scattering that all Gaussians of a training have in common -------------------------------------------
AROUND = [View(azimuth, grazing) for azimuth in range(0, 360, 45) for grazing in (20.0, 45.0, 70.0)]


def slanted(dataset: Dataset, exponent: float) -> Dataset:
    """A slanted box whose γ⁰ follows that power of the cosine."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    turn = trimesh.transformations.rotation_matrix(0.3, (1, 1, 0))
    mesh = trimesh.creation.box((3.0, 2.0, 1.2)).apply_transform(turn).apply_translation([0, 0, 1.2])
    law = ScatteringLaw(0.1, 0.9, exponent)
    images = np.stack([simulate_raycast(mesh, view, dataset.grid, law) for view in AROUND])
    return dataset_of(dataset.grid, [(view, "train") for view in AROUND], images, source={"kind": "raycast"})


def exponents(run: Run) -> torch.Tensor:
    law = run.gaussians.scattering
    assert isinstance(law, NormalLobes)
    return law.parameters[:, 2].exp()


def test_the_exponent_follows_the_images_and_is_one_for_all(dataset: Dataset, config: Config) -> None:
    quicker = replace(config, iterations=120, rates=replace(config.rates, law=0.06))
    sharp, blunt, penalised = slanted(dataset, 8.0), slanted(dataset, 2.0), replace(config, law_penalty=100.0)
    settings = (sharp, quicker), (blunt, quicker), (sharp, penalised)
    narrow, wide, held = (exponents(reconstruct(images, one, quiet=True)) for images, one in settings)
    assert narrow.unique().numel() == wide.unique().numel() == 1
    assert narrow[0] > 4.0 > 3.5 > wide[0] > 1.4
    assert float(held[0]) == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("loss", ["speckle", "amplitude"])
def test_penalties_are_in_nats_beside_a_likelihood(dataset: Dataset, config: Config, loss: str) -> None:
    """Otherwise in units of the loss of black images."""
    trainer = Trainer(dataset, replace(config, loss=loss))
    with torch.no_grad():
        trainer.model.parameters["scattering"][::2] += 1.0
    expected = trainer.model.penalties()["scattering penalty"].item()
    trainer.step()
    share = trainer.terms["scattering penalty"].item() / expected
    assert share == pytest.approx(1, rel=1e-6) if loss == "speckle" else share < 0.1


@pytest.mark.parametrize(("cells", "square"), [(0, 0.25), (30, 0.0)])
def test_scattering_may_differ_from_place_to_place(dataset: Dataset, config: Config, cells: int, square: float) -> None:
    """Student's t of the differences from the mean of 6 cells; those of larger cubes, of 24, are free."""
    model = Trainer(dataset, replace(config, coarsest=1, target_box=(-40, -40, 0, 40, 40, 3))).model
    with torch.no_grad():
        model.parameters["scattering"][::2] += 1.0
        model.parameters["means"][:] = 0.1
        model.parameters["means"][::2, 0] += cells * dataset.grid.cell_m
    penalty = config.scattering_penalty * 2 * 0.36 * math.log1p(square / 0.36)
    assert model.penalties()["scattering penalty"].item() == pytest.approx(penalty, rel=1e-5, abs=1e-7)


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
    parameters = made.reconstruction.gaussians.scattering.parameters  # in the unit of the training
    assert parameters[:, 0].unique().numel() > 1
    assert parameters[:, 1].unique().numel() == parameters[:, 2].unique().numel() == 1
    assert abs(float(parameters[0, 1])) <= 0.01
    assert torch.equal(Run.load(tmp_path / "run").reconstruction.gaussians.scattering.parameters, parameters)


def test_a_law_with_nothing_for_each_gaussian(
    dataset: Dataset, config: Config, tuned: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Tuned, "common", ((0.0, 1.0),) * 3)
    with pytest.raises(SarsplatError, match="with K above the 3 ranges of Tuned"):
        reconstruct(dataset, replace(config, scattering=tuned), quiet=True)


def test_each_gaussian_has_an_exponent_of_its_own_if_asked_for(dataset: Dataset, config: Config) -> None:
    found = exponents(reconstruct(dataset, replace(config, common_law=False), quiet=True))
    assert found.unique().numel() > 100
