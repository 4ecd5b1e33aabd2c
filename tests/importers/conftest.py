"""What tests of importers share."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from functools import cache, partial

import pytest


@pytest.fixture(scope="module", autouse=True)
def small_previews() -> Iterator[None]:
    """Of one image: sheets of twelve take longer than the imports."""
    from sarsplat.report import sheet

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sheet, "check_sheet", partial(sheet.check_sheet, most=1))
        yield


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
