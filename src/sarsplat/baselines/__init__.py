"""Methods of others under one interface, to compare with ours. What needs torch is loaded when first used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sarsplat.baselines.config import BaselineConfig
from sarsplat.baselines.methods import METHODS, Method

if TYPE_CHECKING:
    from sarsplat.baselines.baseline import Baseline, Scene
    from sarsplat.baselines.run import BaselineRun, open_run
    from sarsplat.baselines.training import reconstruct_with

_MODULE_OF = {
    "Baseline": "baseline",
    "BaselineRun": "run",
    "Scene": "baseline",
    "open_run": "run",
    "reconstruct_with": "training",
}

__all__ = ["METHODS", "Baseline", "BaselineConfig", "BaselineRun", "Method", "Scene", "open_run", "reconstruct_with"]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
