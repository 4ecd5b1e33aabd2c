"""Optional packages of single formats."""

from __future__ import annotations

from importlib import import_module

from sarsplat.errors import SarsplatError
from sarsplat.extras import install_command


def require(package: str, what: str, extra: str) -> None:
    """Raise if a package is missing, naming the extra that installs it; `what` begins the error: "SICD files need"."""
    try:
        import_module(package)
    except ImportError as error:
        raise SarsplatError(
            f"{what} {package}, which cannot be imported ({error}); {install_command(extra)}"
        ) from error
