"""Engines: the renderer's and its training's operations on CPUs and NVIDIA GPUs."""
