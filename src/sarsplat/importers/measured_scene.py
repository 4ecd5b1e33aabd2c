"""What importers are told of a scene that no file says; each hands it on to `dataset_of`."""

from __future__ import annotations

from typing import TypedDict

from sarsplat.data.header import Box
from sarsplat.geometry import Terrain


class AboutScene(TypedDict, total=False):
    """What a user knows of the scene.

    Attributes
    ----------
    terrain : Terrain or None
        Heights of the ground that the images show; level unless given.
    target_box_m : pair of (x, y, z) or None
        Lower and upper corner of the box that contains the target, m; x towards the nose, z up. Unless given, it is
        derived from the images.
    """

    terrain: Terrain | None
    target_box_m: Box | None


class AboutImages(AboutScene, total=False):
    """What a user also knows of images that come from anywhere.

    Attributes
    ----------
    looks : float or None
        Number of looks of the speckle, 1 unless given; None if there is none.
    ground : bool
        Whether the images show the ground around the target, as they do unless it is said.
    """

    looks: float | None
    ground: bool
