"""What is wrong with a dataset: whether its images contradict what is said of them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
