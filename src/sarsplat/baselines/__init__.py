"""Methods of others, to compare with ours: what they share. What needs torch is loaded when first used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sarsplat.baselines.baseline import Baseline, BaselineConfig, Scene
    from sarsplat.baselines.method import BaselineMethod

_MODULE_OF = {"Baseline": "baseline", "BaselineConfig": "baseline", "BaselineMethod": "method", "Scene": "baseline"}

__all__ = ["Baseline", "BaselineConfig", "BaselineMethod", "Scene"]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
