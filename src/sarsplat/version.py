"""Versions of packages, and of this program, which its output files record."""

from __future__ import annotations


def installed_version(distribution: str) -> str | None:
    """Version of an installed distribution, or None."""
    from importlib.metadata import PackageNotFoundError, version  # here, because help does without it

    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def program_version() -> str:
    """The installed version."""
    return installed_version("sarsplat") or "from source"
