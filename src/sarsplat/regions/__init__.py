"""Location of the target from the images alone: its box, its outlines, the region to place Gaussians in."""
