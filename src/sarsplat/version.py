"""Version of this program, for what says by which one it was made."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def program_version() -> str:
    """As it was installed."""
    try:
        return version("sarsplat")
    except PackageNotFoundError:
        return "from source"
