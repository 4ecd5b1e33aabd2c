"""A run of made-up chips whose gains and shifts are known, and two in folders."""

from pathlib import Path

import pytest
import torch

from made_runs import made_up
from sarsplat import Run

SHIFTS_M = torch.tensor([[0.3, -0.1], [0.1, 0.1]]).repeat(3, 1)


@pytest.fixture(scope="session")
def run() -> Run:
    made = made_up("box")
    with torch.no_grad():
        assert made.model is not None
        made.model.parameters["log_gain"].copy_(torch.tensor([-0.4, 0.4, -0.4, 0.4, -0.4, 0.4]))
        made.model.parameters["shift"].copy_(SHIFTS_M)
    texture = next(part for part in made.model.parts if part.name == "texture")
    texture.load(texture.state() | {"shift_m": SHIFTS_M})
    return made


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Of two runs that show different things."""
    folder = tmp_path_factory.mktemp("runs")
    made = [made_up(target, folder / f"{target}-run") for target in ("box", "T-72 (a)")]
    return [run.folder for run in made]
