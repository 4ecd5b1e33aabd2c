"""Version of this program, which its output files record."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def program_version() -> str:
    """The installed version."""
    try:
        return version("sarsplat")
    except PackageNotFoundError:
        return "from source"
