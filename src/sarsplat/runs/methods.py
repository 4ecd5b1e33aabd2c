"""Methods: modules `method_NAME.py` of `learning` and `baselines`, and entry points; without torch."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from sarsplat.errors import SarsplatError, shown
from sarsplat.plugins import discover

if TYPE_CHECKING:
    from sarsplat.learning.method import Method

_PLUGINS = discover("sarsplat.learning", "method_", "METHOD", "sarsplat.methods", "sarsplat.baselines")
METHODS: "Mapping[str, Method]" = _PLUGINS
"""Methods by name, as on the command line; imported at first use."""


def method_named(name: str) -> "Method":
    """Return one of `METHODS`; raise for unknown names and failed imports."""
    if name not in METHODS:
        raise SarsplatError(
            f"there is no method {shown(name)}; choose one of {', '.join(METHODS)}, or install the package that has it"
        )
    return METHODS[name]


def module_of(name: str) -> str:
    """Return the module of a method."""
    method_named(name)
    return _PLUGINS.module(name)
