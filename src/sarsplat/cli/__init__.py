"""The command line, `sarsplat`. Commands import what is heavy inside, so that help is instant."""

from sarsplat.cli.app import main

__all__ = ["main"]
