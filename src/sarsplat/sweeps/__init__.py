"""Fleets of runs: datasets, methods, settings and seeds, combined by a plan. Loaded when first used."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
