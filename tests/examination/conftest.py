"""What tests of the examination share."""

import pytest


@pytest.fixture(autouse=True)
def coarsely(monkeypatch: pytest.MonkeyPatch) -> None:
    """The ground is compared in fewer places."""
    monkeypatch.setattr("sarsplat.examination.neighbouring_views._PLACES", 48)
