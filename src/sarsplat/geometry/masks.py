"""What a pixel of a mask may be; the numbers are those of SARBake's labels."""

CLUTTER = 0
"""Neither target nor shadow."""

TARGET = 1
"""A surface of the target that the radar sees."""

SHADOW = 2
"""Ground that the target hides."""
