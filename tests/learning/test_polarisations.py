"""Reconstruction from several polarisations: what returns how, with the same bits again, and passes besides."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from sarsplat import Stack, View, evaluate_run, preset, read_gaussians_ply, reconstruct, simulate_stack, write_report
from sarsplat.data import Dataset, DatasetEntry, write_dataset
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid
from sarsplat.regions.stack_region import stack_region
from sarsplat.runs import Run
from sarsplat.scenes import Mechanisms, ScatteringLaw
from sarsplat.scenes.mechanisms import MATRICES, POLARISATIONS
from sarsplat.settings.presets import PRESETS

GRID = ImageGrid(22, 20, (0.5, 0.5), (0.6, 0.6))
VIEWS = tuple(View(azimuth, 45.0) for azimuth in range(0, 360, 90))
NOISE = 0.05


def block() -> trimesh.Trimesh:
    return trimesh.creation.box((3.0, 3.0, 2.0)).apply_translation((0.0, 0.0, 1.0))


def dataset(offsets: tuple[float, ...] = (0.0,)) -> Dataset:
    """A block that returns by two bounces on all sides, on ground that returns by one."""
    channels = tuple(offset for offset in offsets for _ in POLARISATIONS)
    noise, names = (NOISE,) * len(channels), POLARISATIONS * len(offsets)
    stack = Stack(0.24, channels, noise=noise, polarisations=names)
    two_bounces, law = Mechanisms(np.full(len(block().faces), 1)), ScatteringLaw(2.0, 0.0, 1.0)
    signals = [
        simulate_stack(block(), view, GRID, stack, law, ground_gamma0=0.7, mechanisms=two_bounces, noise=NOISE, seed=k)
        for k, view in enumerate(VIEWS)
    ]
    entries = tuple(DatasetEntry(view, "train", f"{k}", stack=stack) for k, view in enumerate(VIEWS))
    return Dataset.of_complex(GRID, entries, np.stack(signals), target="block", looks=1.0, ground=True)


@pytest.fixture(scope="module")
def polarimetric(tmp_path_factory) -> Dataset:
    return write_dataset(tmp_path_factory.mktemp("polarisations") / "data", dataset(), truth_mesh=block())


@pytest.fixture(scope="module")
def run(polarimetric, tmp_path_factory) -> Run:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "polarimetric", replace(preset("polarimetric"), iterations=240, gaussians=2500))
        return reconstruct(polarimetric, out=tmp_path_factory.mktemp("run") / "run", quiet=True)


def per_power(matrix: np.ndarray) -> np.ndarray:
    return 3 * matrix / np.trace(matrix)


def test_block_and_ground_return_as_they_do(run):
    assert run.config.preset == "polarimetric"
    for box, mechanism in ((((-1.8, -1.8, 0.3), (1.8, 1.8, 2.3)), 1), (((-9.0, -9.0, -0.5), (-2.5, 9.0, 0.5)), 0)):
        found, true = per_power(run.covariance_within(box)), MATRICES[mechanism]
        assert np.linalg.norm(found - true) < 0.25 * np.linalg.norm(true)
        assert np.linalg.norm(found - true) < 0.3 * np.linalg.norm(found - MATRICES[1 - mechanism])
    high = (1.0, 1.0, 1.0)
    for low, upper in (
        (high, (-1.0, -1.0, 0.0)),
        ((float("nan"), 0.0, 0.0), high),
        ((90.0, 0.0, 0.0), (91.0, 1.0, 1.0)),
    ):
        with pytest.raises(SarsplatError, match="no Gaussian lies in the box"):
            run.covariance_within((low, upper))
    with pytest.raises(SarsplatError, match=r"learned without speckle .*preset polarimetric"):
        run.sample(VIEWS[0])


def test_covariances_are_rendered_in_the_units_of_the_images(run, polarimetric):
    found = run.render_covariances(VIEWS, polarimetric.stacks)
    measured = polarimetric.signal[:, :, None] * polarimetric.signal[:, None].conj()
    sums = [np.asarray(each).mean((0, 3, 4)) for each in (found, measured)]
    assert np.linalg.norm(sums[0] - sums[1]) < 0.2 * np.linalg.norm(sums[1])  # priors make it up to 1 dB too dark
    assert np.linalg.norm(per_power(sums[0]) - per_power(sums[1])) < 0.05
    alone = run.render_covariances(VIEWS[:1], Stack(0.24, (0.0,), polarisations=("VV",)))
    np.testing.assert_allclose(alone[0, 0, 0].real + 0, found[0, 2, 2].real, rtol=0.05, atol=2 * NOISE)
    with pytest.raises(SarsplatError, match="a stack has the polarisations RR, and the Gaussians' scattering has HH"):
        run.render_covariances(VIEWS[:1], Stack(0.24, (0.0,), polarisations=("RR",)))


def test_it_is_scored_shown_and_kept(run):
    assert evaluate_run(run, quiet=True)["points"]["visible"]["f1@0.6"] > 0.2  # level ground looks the same anywhere
    page = write_report(run, quiet=True).read_text()
    assert "HH − VV" in page
    assert "azimuth 270°" in page
    law: Any = read_gaussians_ply(run.path / "gaussians.ply").scattering
    assert law.polarisations == POLARISATIONS
    assert torch.equal(law.parameters, run.gaussians.scattering.parameters)
    loaded = Run.load(run.path)
    box = ((-9.0, -9.0, -1.0), (9.0, 9.0, 3.0))
    np.testing.assert_array_equal(loaded.covariance_within(box), run.covariance_within(box))


def test_a_resumed_run_is_the_same_for_any_number_of_threads(polarimetric, tmp_path, threads):
    config = replace(preset("polarimetric"), iterations=9, gaussians=400, checkpoint_every=3)
    threads(1)
    whole = reconstruct(polarimetric, config, quiet=True)
    threads(3)
    reconstruct(polarimetric, config, tmp_path / "run", quiet=True, on_step=lambda step: step.iteration == 6)
    resumed = reconstruct(polarimetric, config, tmp_path / "run", quiet=True, resume=True)
    assert torch.equal(whole.gaussians.means, resumed.gaussians.means)
    assert torch.equal(whole.gaussians.scattering.parameters, resumed.gaussians.scattering.parameters)


def test_passes_and_polarisations_together():
    """Both are learned from; heights are within what phases tell."""
    both = dataset((0.0, 0.01))
    run = reconstruct(both, replace(preset("polarimetric"), iterations=20, gaussians=1500), quiet=True)
    assert run.history[-1].loss < run.history[0].loss - 3
    found = run.render_covariances(VIEWS[:1], both.stacks[0])[0]
    assert found.shape == (6, 6, GRID.rows, GRID.columns)
    values = np.linalg.eigvalsh(np.moveaxis(found, (2, 3), (0, 1)).astype(np.complex128))
    assert values.min() > 0
    level = both.stacks[0].plane_phases(VIEWS[0], GRID)
    between = [(found[3 + k, k] * np.exp(-1j * (level[3] - level[0]))).sum() for k in range(3)]
    assert np.ptp(np.angle(between)) < 0.3  # polarisations have the phase of their pass


def test_polarisations_are_looked_for_as_high_as_what_stands_out(polarimetric):
    region = stack_region(polarimetric.select("train"))
    assert 1.5 < region.high[2] < 5
    assert -1 < region.low[2] < 0
    without = replace(polarimetric, ground=False)
    assert stack_region(without.select("train")).low[2] >= 0
