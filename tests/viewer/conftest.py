"""A short training on a small box, to look at."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from made import FEW_POINTS, box_dataset
from sarsplat import Config, Dataset, ImageGrid, Run, preset, reconstruct

GRID = ImageGrid(40, 32, (0.3, 0.24), (0.45, 0.4))


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return box_dataset(tmp_path_factory.mktemp("box"), GRID)


@pytest.fixture(scope="session")
def config() -> Config:
    short = {"iterations": 20, "gaussians": 400, "harmonics_every": 10, "checkpoint_every": 1000}
    return replace(preset("default"), **short, points=FEW_POINTS)


@pytest.fixture(scope="session")
def finished(dataset: Dataset, config: Config, tmp_path_factory: pytest.TempPathFactory) -> Run:
    pytest.importorskip("sklearn")
    return reconstruct(dataset, config, tmp_path_factory.mktemp("run") / "run", quiet=True)


@pytest.fixture
def viewer(finished: Run) -> Iterator[Viewer]:  # noqa: F821
    pytest.importorskip("viser")
    from sarsplat.viewer import Viewer, subject_at

    with Viewer(subject_at(finished.folder)) as shown:
        assert shown.wait(60)
        yield shown
