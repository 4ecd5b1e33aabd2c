"""What is asked of runs for samples that cannot be had: one sentence each."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from sarsplat import Gaussians, Harmonics, Run, SarsplatError, View, chips
from sarsplat.learning.method import Reconstruction
from sarsplat.samples import write_chips

SETS: list[tuple[dict[str, Any], str]] = [
    *(({"count": count}, f"count is {count}; give 1 to 100000000 chips") for count in (0, 10**20)),
    ({"azimuths_deg": [float("inf")]}, "azimuth inf is not a number between"),
    ({"grazing_deg": (20.0, 10.0)}, "grazing 20:10 goes down; give the lower"),
    ({"grazing_deg": (0.0, 10.0)}, "grazing angle 0.0° is outside"),
    ({"crop": 33}, "crop is 33, but the images of the runs have 32 × 36 pixels; give at most 32"),
    ({"crop": 0}, "crop is 0; give at least one"),
    ({"quantity": "phase"}, "quantity is 'phase'; give one of 'magnitude', 'power', 'complex'"),
    ({"scale": "calibrated", "format": "png"}, "scale is 'calibrated', which the 8 bits of png cannot hold"),
    ({"jpeg_quality": 101}, "jpeg_quality is 101; give 1 to 100"),
    ({"ground": "Uniform"}, "ground is 'Uniform'; give learned, uniform or the file of a picture"),
]
SINGLE: list[tuple[dict[str, Any], str]] = [
    ({"seed": -1}, "seed.* -1"),
    ({"speckle": "grey"}, "speckle is 'grey'; give one of 'response', 'white', 'none'"),
    ({"ground": "lerned"}, "ground is 'lerned'; give learned, uniform, or its power"),
    *(
        ({"ground": np.full((64, 36), bad, np.float32)}, r"is \[64, 36\] numbers, .*; give power")
        for bad in (math.nan, math.inf, -1.0)
    ),
    *(({"scatterers": few}, r"scatterers is .*; give a number above 0, or inf") for few in (0.0, -1.0, math.nan)),
]


def of_own_gaussians() -> Run:
    parts = (torch.ones(1, columns) for columns in (3, 4, 3))
    return Run.from_gaussians(Gaussians(*parts, optical_depth=torch.ones(1), scattering=Harmonics(torch.ones(1, 1))))


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        *((lambda run, options=options: chips([run], **options), words) for options, words in SETS),
        *((lambda run, options=options: run.sample(View(40, 17), **options), words) for options, words in SINGLE),
        (lambda run: chips([]), "there are no runs"),
        (lambda run: write_chips(chips([run], count=1), "out", shard=0), "shard is 0; give at least one"),
        (lambda run: of_own_gaussians().sample(View(40, 17)), "was learned without speckle"),
        (lambda run: Reconstruction.sampler(run, "learned", "response", 1.0), "not how single ones differ"),
    ],
)
def test_what_is_refused(run: Run, ask, words, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SarsplatError, match=words):
        ask(run)
    assert not list(tmp_path.iterdir())
