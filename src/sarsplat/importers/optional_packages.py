"""Packages that single formats need: they come with an extra of ours, and may be missing."""

from __future__ import annotations

from importlib import import_module

from sarsplat.errors import SarsplatError
from sarsplat.extras import install_command


def require(package: str, what: str, extra: str) -> None:
    """Refuse to go on without a package, and say how to get it; `what` needs it, such as "SICD files need"."""
    try:
        import_module(package)
    except ImportError as error:
        raise SarsplatError(
            f"{what} {package}, which cannot be imported ({error}); {install_command(extra)}"
        ) from error
