"""Pictures that are quick to draw."""

import pytest


@pytest.fixture(autouse=True)
def few_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sarsplat.report.write._SURFACE_SAMPLES", 500)
    monkeypatch.setattr("sarsplat.report.boards._PIXELS", 40)
    monkeypatch.setattr("sarsplat.report.widget._MOST_RENDERED", 20_000)
