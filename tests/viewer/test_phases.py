"""The phase between two passes in the viewer, where a run has learned it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from made import dataset_of
from sarsplat import ImageGrid, Run, ScatteringLaw, Stack, View, preset, reconstruct, simulate_stack
from sarsplat.colours import DARK
from sarsplat.viewer.run_subject import subject_of_run

pytest.importorskip("viser")

from sarsplat.viewer import Viewer
from sarsplat.viewer.pictures import MAPS, PHASES, phase_panel

VIEW, GRID = View(0.0, 45.0), ImageGrid(24, 20, (0.5, 0.5), (0.6, 0.6))


@pytest.fixture(scope="module")
def run() -> Run:
    """Of level ground."""
    stack = Stack(0.031, (0.0, 0.001, 0.003), noise=(0.02,) * 3)
    speck = trimesh.creation.box((0.01, 0.01, 0.01))
    law = ScatteringLaw(1.0, 0.0, 1.0)
    signals = simulate_stack(speck, VIEW, GRID, stack, law, ground_gamma0=1.0, noise=0.02)
    dataset = dataset_of(GRID, [(VIEW, "train")], signals[None], stack=stack, looks=1.0, ground=True)
    return reconstruct(dataset, replace(preset("stack"), iterations=60), quiet=True)


@pytest.mark.parametrize("view", [VIEW, View(30.0, 40.0)])
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
