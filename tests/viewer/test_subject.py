"""Runs and datasets as the page sees them, and phases between passes."""

import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from made import FEW_POINTS, dataset_of
from sarsplat import ImageGrid, Run, SarsplatError, ScatteringLaw, Stack, View, preset, reconstruct, simulate_stack
from sarsplat.colours import DARK
from sarsplat.radar import Pixel
from sarsplat.viewer import Viewer, subject_at
from sarsplat.viewer.pictures import MAPS, PHASES, phase_panel
from sarsplat.viewer.subject import TRUTH, dataset_subject, subject_of_run
from sarsplat.viewer.viewer import _explained

VIEW = View(40.0, 30.0)


def test_a_run_renders_what_it_renders_elsewhere(finished):
    subject = subject_at(finished.folder)
    image, exact = subject.render(VIEW), finished.render([VIEW])[0]
    assert image.shape == exact.shape
    assert np.abs(image - exact).max() < 0.02 * exact.max()  # of coarser rays
    assert not subject.has_ground


def test_its_clouds_have_colours_for_everything_that_is_known(finished):
    subject = subject_at(finished.folder)
    points, gaussians, truth = subject.clouds
    assert truth.name == TRUTH
    assert len(gaussians.places_m) <= len(finished.gaussians)
    for cloud in (points, gaussians):
        gamma0, error = subject.gamma0(cloud, VIEW), subject.error_m(cloud)
        assert gamma0.shape == error.shape == (len(cloud.places_m),)
        assert (gamma0 > 0).all()
    on_top = np.array([[0.0, 0.0, 1.5]], np.float32)  # the box ends at 1.2 m
    assert subject.error_m(replace(points, name="one", places_m=on_top)) == pytest.approx(0.3, abs=1e-3)


def test_the_shares_of_a_pixel_add_up_and_lie_on_its_line(finished):
    subject = subject_at(finished.folder)
    image = subject.render(VIEW)
    row, column = np.unravel_index(image.argmax(), image.shape)
    contributors = subject.contributors(VIEW, Pixel(int(row), int(column)))
    assert contributors.shares.sum() == pytest.approx(1.0, abs=1e-4)
    assert (np.diff(contributors.shares) <= 0).all()
    assert contributors.ground_share == 0
    assert subject.contributors(VIEW, Pixel(0, 0)) is None


def test_a_wall_is_at_its_foot_too_where_second_bounces_were_simulated(dataset):
    subject = dataset_subject(dataset)
    mirror = dataset_subject(replace(dataset, source=dataset.source | {"ground_reflectivity": 1.0}))
    column, shares = dataset.grid.columns // 2, []
    for row in range(dataset.grid.rows):
        direct, both = (one.contributors(VIEW, Pixel(row, column)) for one in (subject, mirror))
        assert direct is None or direct.by_ground_share == 0
        shares.append(0.0 if both is None else both.by_ground_share)
    row = int(np.argmax(shares))
    both = mirror.contributors(VIEW, Pixel(row, column))
    assert both is not None
    assert both.by_ground_share > 0.5
    assert both.shares.sum() == pytest.approx(1.0, abs=1e-4)
    place = Pixel(row, column).place_m(dataset.grid)
    feet = both.places_m[:20, :2] @ VIEW.look.gradients[:, :2].T
    assert np.abs(feet - place).max() < 2 * max(dataset.grid.resolution_m)
    assert "returns by way of the ground" in _explained(both, False)


def test_the_nearest_view_is_an_angle_away(dataset):
    subject = dataset_subject(dataset)
    index, apart_deg = subject.nearest(View(120.0, 24.0))
    assert subject.views[index] == (View(120.0, 20.0), "train")
    assert apart_deg == pytest.approx(4.0)
    assert subject.nearest(subject.views[3][0])[1] < 1e-6


def test_a_dataset_has_its_images_and_its_true_surface(dataset):
    subject = subject_at(dataset.path)
    assert not subject.renders and not subject.scatters and not subject.knows_errors
    assert [cloud.name for cloud in subject.clouds] == [TRUTH]
    maps = subject.maps(VIEW)
    assert np.nanmax(maps.height_m) == pytest.approx(1.2, abs=0.1)
    assert maps.shadow.any()


def test_without_a_shape_the_box_is_where_the_images_show_something(dataset):
    subject = dataset_subject(replace(dataset, truth_mesh=None))
    low, high = subject.box_m
    assert subject.clouds == [] and subject.maps(VIEW) is None and subject.contributors(VIEW, Pixel(20, 16)) is None
    assert (low < [-1, -0.6, 1.2]).all() and (high > [1, 0.6, 0.5]).all()
    assert (high - low < 8).all()


def test_a_run_needs_no_dataset(finished, tmp_path):
    shutil.copytree(finished.folder, tmp_path / "run")
    header = tmp_path / "run" / "config.json"
    header.write_text(header.read_text().replace(str(finished.dataset_path), str(tmp_path / "gone")))
    for folder, why in ((tmp_path, "is neither a run nor a dataset; give the folder of one"), ("no", "does not exist")):
        with pytest.raises(SarsplatError, match=why):
            subject_at(folder)
    subject = subject_at(tmp_path / "run")
    assert subject.dataset is None
    assert {split for _, split in subject.views} == {"train"}
    assert subject.render(VIEW).max() > 0


def test_ground_and_its_shadow_can_be_left_out(dataset):
    ground = replace(dataset, power=dataset.power + np.float32(0.05), ground=True, looks=1.0)
    config = replace(preset("measured"), iterations=20, gaussians=300, points=FEW_POINTS)
    run = reconstruct(ground, config, quiet=True)
    subject = subject_of_run(run)
    assert subject.has_ground
    whole, bare = subject.render(VIEW), subject.render(VIEW, ground=False)
    unshadowed = subject.render(VIEW, shadow=False)
    assert bare.mean() < 0.7 * whole.mean()
    assert (unshadowed >= whole * (1 - 1e-3)).all()  # nothing hides anything
    assert unshadowed.sum() > whole.sum()
    assert np.isclose(unshadowed[0], whole[0], rtol=0.05).all()  # far from the target


def test_a_copied_scene_stays_when_the_original_is_trained_on(finished):
    model = finished.model
    copied, before = model.copy(), model.parameters["means"].detach().clone()
    with torch.no_grad():
        model.parameters["means"].add_(1.0)
    assert torch.equal(copied.parameters["means"], before)
    with torch.no_grad():
        model.parameters["means"].copy_(before)


def test_of_views_from_one_direction_the_nearest_is_turned_alike(dataset):
    view = dataset.views[2]
    other = replace(view, tilt_deg=40.0)
    entries = (*dataset.entries, replace(dataset.entries[2], view=other, name="other"))
    power = np.concatenate([dataset.power, dataset.power[2:3]])
    subject = dataset_subject(replace(dataset, entries=entries, power=power))
    assert subject.nearest(other) == (len(dataset), 0.0)
    assert subject.nearest(view) == (2, 0.0)


# ---- the phase between two passes ------------------------------------------------------------------------------------
LOOK, GRID = View(0.0, 45.0), ImageGrid(24, 20, (0.5, 0.5), (0.6, 0.6))


@pytest.fixture(scope="module")
def run() -> Run:
    """Of level ground."""
    stack = Stack(0.031, (0.0, 0.001, 0.003), noise=(0.02,) * 3)
    speck = trimesh.creation.box((0.01, 0.01, 0.01))
    law = ScatteringLaw(1.0, 0.0, 1.0)
    signals = simulate_stack(speck, LOOK, GRID, stack, law, ground_gamma0=1.0, noise=0.02)
    dataset = dataset_of(GRID, [(LOOK, "train")], signals[None], stack=stack, looks=1.0, ground=True)
    return reconstruct(dataset, replace(preset("stack"), iterations=30), quiet=True)


@pytest.mark.parametrize("view", [LOOK, View(30.0, 40.0)])
def test_level_ground_has_no_phase_from_any_view(run: Run, view: View) -> None:
    subject = subject_of_run(run)
    assert subject.knows_phases
    shown, pair = subject.interferogram(view)
    assert pair.cycle_m > 0 and shown.phase.shape == (24, 20)
    bright = run.render([view])[0] > 0.3
    assert bright.mean() > 0.4
    assert abs(np.median(shown.phase[bright])) < 0.15
    assert np.median(shown.coherence[bright]) > 0.6


def test_the_page_offers_it(run: Run, finished: Run) -> None:
    pytest.importorskip("viser")
    with Viewer(subject_of_run(run)) as viewer:
        choice = viewer._controls._set["map"]
        assert choice.visible and PHASES in choice.options
        choice.value = PHASES
        assert viewer.wait(60)
        titles = [row[0].content for row in viewer._controls._rows if row[0].visible]
        assert any("phase above level ground" in title for title in titles)
    with Viewer(subject_of_run(finished)) as viewer:
        assert viewer._controls._set["map"].options == ("none", *MAPS)


def test_its_colours_close() -> None:
    panel = phase_panel(np.array([[-math.pi, 0.0, math.pi]]), 12.34, DARK)
    ends = panel.rgb[0].astype(int)
    assert np.abs(ends[0] - ends[2]).max() < 10 < np.abs(ends[0] - ends[1]).max()
    assert "one cycle is 12.3 m of height" in panel.legend
