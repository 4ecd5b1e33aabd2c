"""Versions of packages and of this program."""

from __future__ import annotations


def installed_version(distribution: str) -> str | None:
    """Return the version of an installed distribution, or None."""
    from importlib.metadata import PackageNotFoundError, version  # here, because help does not need it

    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def program_version() -> str:
    """Return the version of this program, which output files record."""
    return installed_version("sarsplat") or "from source"
