"""What a pixel of a mask may be; the numbers are those of SARBake's labels."""

CLUTTER, TARGET, SHADOW = 0, 1, 2
"""Neither target nor shadow; a surface of the target that the radar sees; ground that the target hides."""
