"""Polarisations of training images beside those of what was learned, in the colours of Pauli's basis."""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex, Float64

from sarsplat.data.coverage import evenly_chosen
from sarsplat.radiometry import white_level
from sarsplat.report.figure import Block, Figure
from sarsplat.report.images import Part, address, indexed, target_window, view_name
from sarsplat.report.interferogram import averaged, covariances
from sarsplat.runs import Run

PAULI = frozenset(("HH", "VV"))
"""Polarisations without which there is no such picture."""

_SHOWN, _LARGEST = 3, 256
_BRIGHT = 0.99
"""Quantile of the measured powers that is drawn as bright as can be."""


def pauli(
    matrices: Complex[np.ndarray, "p p rows columns"], polarisations: tuple[str, ...]
) -> Float64[np.ndarray, "3 rows columns"]:
    """Powers of HH − VV (two bounces), of the cross-polarised channels (volumes), and of HH + VV (one bounce).

    E|HH ∓ VV|² / 2, and of HV and VH the sum, or twice what there is of them.
    """
    hh, vv = polarisations.index("HH"), polarisations.index("VV")
    both, between = matrices[hh, hh].real + matrices[vv, vv].real, matrices[hh, vv].real
    crossed = [matrices[i, i].real for i, name in enumerate(polarisations) if name in ("HV", "VH")]
    volume = 2 * np.mean(crossed, axis=0) if crossed else np.zeros_like(both)
    return np.stack([both / 2 - between, volume, both / 2 + between]).astype(np.float64)


def pauli_figure(run: Run, window: int) -> Figure:
    """Some training images of the run's dataset in HH and VV, averaged over so many pixels, and what was learned."""
    train = run.dataset.select("train")
    assert train.signal is not None  # of stacks
    part = Part.of(train.grid, target_window(train.power, white_level(train.power), train.score_margin), _LARGEST)
    shown = evenly_chosen(train.views, min(_SHOWN, len(train)))
    measured, rendered = [], []
    for index in shown:
        stack, samples = train.stacks[index], covariances(train.signal[index])
        measured.append(averaged(pauli(samples, stack.of_channels), window))
        rendered.append(pauli(run.render_covariances([train.views[index]], stack)[0], stack.of_channels))
    brightest = max(float(np.quantile(np.stack(measured), _BRIGHT)), np.finfo(np.float32).tiny)
    blocks = []
    for name, images in (("measured", measured), ("rendered", rendered)):
        panels = []
        for index, image in zip(shown, images, strict=True):
            colours = indexed(np.sqrt(part.of_images(image.clip(min=0)) / brightest), 0, 1)
            title = f"azimuth {round(train.views[index].azimuth_deg, 1):g}°"
            picture = address(np.ascontiguousarray(np.moveaxis(colours, 0, -1)))
            panels.append(part.panel(title, f"{name}: polarisations, {view_name(train.views[index])}", image=picture))
        blocks.append(Block(name, tuple(panels)))
    text = (
        "Training images and what was learned of them. Red is the power of HH − VV, which two bounces make strong; "
        "green that of the cross-polarised channels, which volumes do; blue that of HH + VV, which single bounces do. "
        f"Brightness is amplitude, measured ones averaged over {window} × {window} pixels, as in training."
    )
    return Figure("Polarisations", text, tuple(blocks))
