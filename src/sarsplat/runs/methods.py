"""Which methods there are: modules `method_NAME.py` of `learning` and `baselines`, and entry points. Needs no torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from sarsplat.errors import SarsplatError, shown
from sarsplat.plugins import discover

if TYPE_CHECKING:
    from sarsplat.learning.method import Method

_PLUGINS = discover("sarsplat.learning", "method_", "METHOD", "sarsplat.methods", "sarsplat.baselines")
METHODS: Mapping[str, Method] = _PLUGINS
"""By name, as on the command line; each is imported when it is asked for."""


def method_named(name: str) -> Method:
    """One of `METHODS`; a SarsplatError if there is none of that name, or it cannot be imported."""
    if name not in METHODS:
        raise SarsplatError(f"there is no method {shown(name)}; choose one of {', '.join(METHODS)}")
    return METHODS[name]


def module_of(name: str) -> str:
    """The module that a method is, ours or another package's."""
    method_named(name)
    return _PLUGINS.module(name)
