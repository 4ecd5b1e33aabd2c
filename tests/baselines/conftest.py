"""A box on the ground, seen from twelve sides, with masks."""

import pytest

from datasets import box_dataset
from sarsplat import Dataset, ImageGrid


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return box_dataset(tmp_path_factory.mktemp("box"), ImageGrid(28, 24, (0.3, 0.35), (0.3, 0.35)), masks=True)
