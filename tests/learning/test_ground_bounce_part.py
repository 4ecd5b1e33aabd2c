"""Learning with the second bounce by way of the ground: how much is reflected is learned, and runs keep it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from made import FEW_POINTS, dataset_of, hill, upright
from made_runs import assert_same, trained
from sarsplat import Dataset, Ground, Run, preset, reconstruct
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import NormalLobes
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.learning.method import Inputs
from sarsplat.learning.model import SceneModel
from sarsplat.learning.observations.single_images import PartsOfImages, SingleImages
from sarsplat.learning.observations.stacks import Stacks
from sarsplat.learning.snapshot import Snapshot
from sarsplat.radar import Pixel
from sarsplat.renderer import GroundBounce, render
from sarsplat.report.page import _run_facts
from sarsplat.settings.sections import Bounce, FlatGround
from sarsplat.viewer.subject import training_subject

GRID = ImageGrid(36, 36, (0.3, 0.3), (0.3, 0.3))
VIEWS = [View(45.0 * k + 10.0, (20.0, 40.0, 60.0)[k % 3]) for k in range(8)]
SHORT = replace(
    preset("default"),
    iterations=120,
    gaussians=150,
    coarsest=1,
    harmonics_every=10,
    points=FEW_POINTS,
    ground=FlatGround(pitch=0.0),
    bounce=Bounce(),
)


def seen(reflectivity: float) -> Dataset:
    """A block of 2 × 1 × 1.2 m with a mirror below."""
    steps = [np.arange(low, high, 0.2) + 0.1 for low, high in ((-1, 1), (-0.5, 0.5), (0, 1.2))]
    means = np.stack(np.meshgrid(*steps), -1).reshape(-1, 3)
    block = upright(means, [0.1, 0.11, 0.12], 2.0, NormalLobes.initial(len(means), 0.5, 0.05))
    ground = Ground(torch.tensor(0.05))
    with torch.no_grad():
        bounce = GroundBounce(ground, torch.tensor(reflectivity))
        images = render(block, VIEWS, GRID, ground=ground, echoes=[bounce]).channel(0).numpy()
    return dataset_of(GRID, [(view, "train") for view in VIEWS], images, ground=True)


@pytest.fixture(scope="module")
def mirrored() -> Dataset:
    return seen(0.8)


def reflectivity(model: SceneModel) -> float:
    return float(model.parameters["ground_reflectivity"].detach())


def test_how_much_is_reflected_follows_the_images_once_there_is_a_shape(mirrored: Dataset) -> None:
    quick = replace(SHORT, iterations=60, law_from=0.5, rates=replace(SHORT.rates, nuisance=0.03))
    bare, mirror = (trained(dataset, quick, 60).model for dataset in (seen(0.0), mirrored))
    assert reflectivity(bare) < 0.1
    assert reflectivity(mirror) > 0.4
    assert reflectivity(trained(mirrored, replace(quick, iterations=15, law_from=1.0), 15).model) == pytest.approx(0.3)
    shares = mirror.power_by_echo(3)
    assert sum(shares.values()) == pytest.approx(1.0)
    assert list(shares) == ["target", "ground", "by way of the ground"]
    assert 0.05 < shares["by way of the ground"] < 0.5


def test_runs_keep_it_and_go_on_with_the_same_bits(mirrored: Dataset, tmp_path: Path) -> None:
    short = replace(SHORT, iterations=30, law_from=0.0)
    trained(mirrored, short, 12).snapshot(0.0).save(tmp_path / "checkpoint")
    resumed = trained(mirrored, short, 3, Snapshot.load(tmp_path / "checkpoint"))
    assert_same(trained(mirrored, short, 15).snapshot(0.0), resumed.snapshot(0.0))
    assert reflectivity(resumed.model) != pytest.approx(0.3)

    whole = reconstruct(mirrored, short, out=tmp_path / "whole", quiet=True)
    kept = Run.load(tmp_path / "whole")
    images = kept.render(VIEWS[:1])
    assert np.array_equal(images, whole.render(VIEWS[:1]))
    assert kept.model is not None
    assert kept.facts["second bounce"].endswith(f"reflects {reflectivity(kept.model):.3g} of the power")
    assert _run_facts(kept)["power"].startswith("target ")
    model, rays = kept.model, RayGrid.for_image(GRID, 4.0)  # those of a run's images
    with torch.no_grad():
        direct = render(model.scene(3), VIEWS[:1], GRID, rays=rays, ground=model.ground())
        bounced = render(model.scene(3), VIEWS[:1], GRID, rays=rays, ground=model.ground(), echoes=model.echoes())
    assert np.allclose(bounced.channel(0).numpy(), images, rtol=1e-5)
    assert images.sum() > direct.channel(0).sum() * 1.01


def test_samples_have_it(mirrored: Dataset) -> None:
    run = reconstruct(mirrored, replace(SHORT, iterations=20, loss="speckle"), quiet=True)
    sample = np.abs(run.sample(VIEWS[0], seed=0, speckle="none")) ** 2
    assert np.allclose(sample, run.render(VIEWS[:1])[0], rtol=0.05, atol=1e-3 * sample.max())
    assert run.model is not None
    with torch.no_grad():
        without = render(run.model.scene(3), VIEWS[:1], GRID, ground=run.model.ground()).channel(0)
    assert sample.sum() > float(without.sum()) * 1.01


def test_the_viewer_tells_whose_foot_is_in_a_pixel(mirrored: Dataset) -> None:
    trainer = trained(mirrored, replace(SHORT, iterations=60), 60)
    subject = training_subject(mirrored, trainer)
    (echo,) = trainer.model.echoes()
    with torch.no_grad():
        bounced = render(trainer.model.scene(3), VIEWS[:1], GRID, ground=trainer.model.ground(), echoes=[echo]).echoes[
            1
        ][0]
    row, column = np.unravel_index(int(bounced.argmax()), bounced.shape)
    found = subject.contributors(VIEWS[0], Pixel(int(row), int(column)))
    assert found is not None
    assert 0.1 < found.by_ground_share < 1
    assert np.array_equal(subject.render(VIEWS[0], ground=False), subject.render(VIEWS[0], ground=False, shadow=False))


def test_what_it_cannot_be_combined_with_is_refused(mirrored: Dataset) -> None:
    with pytest.raises(SarsplatError, match="bounce is on, but needs ground, which is off; switch ground on"):
        replace(SHORT, ground=None)
    assert Stacks.goes_with["ground"] is None  # without which there is no bounce
    with pytest.raises(SarsplatError, match="bounce is on, which needs level ground"):
        SingleImages.refuse(SHORT, replace(mirrored, terrain=hill()), Inputs())
    with pytest.raises(SarsplatError, match="bounce is on, which cannot be combined with tiles 2; give off, or"):
        PartsOfImages.refuse(replace(SHORT, tiles=2), mirrored, Inputs())
