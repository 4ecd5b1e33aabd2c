"""Finished tiles on the disk: a rendering that was stopped goes on from them."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.data.files import plain_os_errors, write_bytes
from sarsplat.gaussians import Gaussians
from sarsplat.tiles.plan import Tile


class Kept:
    """A folder of tiles, each a file, which is whole or absent.

    Parameters
    ----------
    folder : Path
        Made if it is not there.
    gaussians : Gaussians
        The scene.
    settings : object
        What else the image depends on; its `repr` says all of it.
    """

    def __init__(self, folder: Path, gaussians: Gaussians, *settings: object) -> None:
        digest = hashlib.blake2b(repr((gaussians.scattering.settings(), settings)).encode(), digest_size=8)
        for tensor in gaussians.tensors().values():
            digest.update(tensor.detach().cpu().contiguous().numpy())
        self._folder = folder / digest.hexdigest()
        with plain_os_errors("write", self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)

    def image(
        self, tile: Tile, make: Callable[[], Float[Tensor, "c rows columns"]]
    ) -> Float[Tensor, "c rows columns"]:
        """The tile's image as it was kept, or else made and kept now."""
        path = self._folder / f"{tile.rows.start}-{tile.columns.start}-{tile.grid.rows}-{tile.grid.columns}.npy"
        if path.is_file():
            with plain_os_errors("read", path):
                return torch.from_numpy(np.load(path, allow_pickle=False))
        image, buffer = make(), io.BytesIO()
        np.save(buffer, image.numpy(), allow_pickle=False)
        write_bytes(path, buffer.getvalue())
        return image
