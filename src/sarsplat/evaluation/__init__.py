"""Scores of images against unseen views and of points against the true surface, and baselines for both."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
