"""A configuration comes back as it was, and takes nothing that would fail an hour later."""

from __future__ import annotations

from typing import Any

import pytest

from sarsplat.errors import SarsplatError
from sarsplat.reconstruction.config import PRESETS, Config


@pytest.mark.parametrize("name", PRESETS)
def test_round_trip(name: str) -> None:
    assert Config.from_dict(PRESETS[name].as_dict()) == PRESETS[name]


@pytest.mark.parametrize(
    ("preset", "path", "value"),
    [
        ("default", "iterations", 0),
        ("default", "iterations", 2.5),
        ("default", "iterations", True),
        ("default", "seed", -1),
        ("default", "preset", 3),
        ("default", "loss", "l2"),
        ("default", "initialisation", ["box"]),
        ("default", "p_min", "0.03"),
        ("default", "initial_scale", None),
        ("default", "scale_bounds", [0.01]),
        ("default", "scale_bounds", [0.3, 0.01]),
        ("default", "scale_bounds", [1e-9, 0.3]),
        ("default", "scale_bounds", [0.01, "0.3"]),
        ("default", "rates.means", None),
        ("default", "rates.scattering", {}),
        ("default", "points.method", "best"),
        ("default", "points.voxel", "fine"),
        ("paper", "densification.start", 10_000.5),
        ("paper", "densification.most", None),
        ("paper", "densification", [1]),
        ("measured", "surroundings.noise_floor", [0.1]),
        ("measured", "surroundings", 7),
        ("default", "x" * 5000, 1),
        ("default", "loss", "x" * 5000),
    ],
)
def test_wrong_values_are_refused_in_a_short_sentence(preset: str, path: str, value: Any) -> None:
    data = PRESETS[preset].as_dict()
    *groups, name = path.split(".")
    record = data
    for group in groups:
        record = record[group]
    record[name] = value
    with pytest.raises(SarsplatError, match=r"does not do in a configuration|does not fit this version") as refusal:
        Config.from_dict(data)
    assert len(str(refusal.value)) < 400
