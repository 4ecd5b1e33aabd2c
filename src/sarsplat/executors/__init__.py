"""Executors of independent jobs (sweep runs, tiles), locally or on Ray; imported at first use."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
