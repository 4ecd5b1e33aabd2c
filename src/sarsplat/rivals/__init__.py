"""Methods of others under one interface, to compare with ours. What needs torch is loaded when first used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sarsplat.rivals.config import RivalConfig
from sarsplat.rivals.methods import METHODS, Method

if TYPE_CHECKING:
    from sarsplat.rivals.rival import Rival, Scene
    from sarsplat.rivals.run import RivalRun, open_run
    from sarsplat.rivals.training import reconstruct_with

_MODULE_OF = {
    "Rival": "rival",
    "RivalRun": "run",
    "Scene": "rival",
    "open_run": "run",
    "reconstruct_with": "training",
}

__all__ = ["METHODS", "Method", "Rival", "RivalConfig", "RivalRun", "Scene", "open_run", "reconstruct_with"]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
