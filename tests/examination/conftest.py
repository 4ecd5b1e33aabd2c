"""What tests of the examination share."""

import pytest


@pytest.fixture(autouse=True)
def coarsely(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare the ground in fewer samples."""
    monkeypatch.setattr("sarsplat.examination.neighbouring_views._SAMPLES", 48)
