"""What tests of importers share."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from functools import cache

import pytest


@pytest.fixture(scope="session", autouse=True)
def schemas_are_read_once() -> Iterator[None]:
    """Sarkit reads the types of a version of SICD from JSON anew for each file."""
    with pytest.MonkeyPatch.context() as patch:
        if importlib.util.find_spec("sarkit"):
            xml = importlib.import_module("sarkit.sicd._xml")
            patch.setattr(xml.XsdHelper, "get_transcoder", cache(xml.XsdHelper.get_transcoder))
            patch.setattr(xml, "XsdHelper", cache(xml.XsdHelper))
        yield


@pytest.fixture(scope="module")
def unexamined() -> Iterator[None]:
    """For tests of imports alone: no examination of their images."""
    from sarsplat.examination.outcome import Examination

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sarsplat.examination.contradictions.examine", lambda dataset: Examination())
        yield


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of messages of imports alone: an empty preview."""
    monkeypatch.setattr("sarsplat.report.sheet.check_sheet", lambda *_, **__: b"")
