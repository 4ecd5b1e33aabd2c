"""`sarsplat view`: a page on this machine in which the radar is dragged around the target. Needs the extra `view`."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sarsplat.viewer.live import watched
    from sarsplat.viewer.run_subject import subject_at
    from sarsplat.viewer.subject import Subject
    from sarsplat.viewer.viewer import Viewer

_MODULE_OF = {"Subject": "subject", "Viewer": "viewer", "subject_at": "run_subject", "watched": "live"}

__all__ = ["Subject", "Viewer", "subject_at", "watched"]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
