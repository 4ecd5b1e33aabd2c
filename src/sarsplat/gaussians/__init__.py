"""The scene model: parameters, covariance, harmonics."""

from sarsplat.gaussians.gaussians import MAX_OPTICAL_DEPTH, MIN_SCALE, Gaussians, join

__all__ = ["MAX_OPTICAL_DEPTH", "MIN_SCALE", "Gaussians", "join"]
