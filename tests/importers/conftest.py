"""What tests of importers share."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import pytest


@pytest.fixture(scope="module", autouse=True)
def small_previews() -> Iterator[None]:
    """Of one image: sheets of twelve take longer than the imports."""
    from sarsplat.report import check_sheet

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(check_sheet, "check_sheet", partial(check_sheet.check_sheet, most=1))
        yield


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of what imports say alone: no preview."""
    monkeypatch.setattr("sarsplat.cli.imported._draw", lambda *_: None)
