"""The report's figures of runs that were learned from stacks."""

from __future__ import annotations

from pathlib import Path

from sarsplat.report.figure import Figure
from sarsplat.report.layover import brightest_layover
from sarsplat.report.pauli import PAULI, pauli_figure
from sarsplat.report.phases import phases_figure, window_of
from sarsplat.report.tomography import slice_figure
from sarsplat.runs import Run


def stack_figures(run: Run, truth: Path | None) -> list[Figure]:
    """What the images show besides power, none if the run was learned from power alone.

    Polarisations in colours; or phase and coherence, and a slice through layover. `truth` is the mesh of the true
    surface, if that is known.
    """
    if run.model is None or run.config.passes is None:
        return []
    if run.dataset.polarimetric:
        return [pauli_figure(run)] if set(run.dataset.stacks[0].of_channels) >= PAULI else []
    index, cut = brightest_layover(run.dataset, run.points, window_of(run))
    phases = phases_figure(run, index, cut)
    tomography = slice_figure(run, cut, truth)
    return [phases] if tomography is None else [phases, tomography]


def which_points(run: Run) -> str:
    """Description of how the points of a run were found, for captions."""
    if run.dataset.passes and run.model is not None and run.config.passes is not None:
        return f"The centres of the Gaussians that together return {run.config.points.power_share:.0%} of the power"
    return "The first returns of the training views' rays"
