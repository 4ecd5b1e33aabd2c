"""Cache of finished tiles on disk, from which an interrupted rendering resumes."""

import hashlib
import io
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.data.files import plain_os_errors, write_bytes
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.tiles.plan import Tile

_folder: ContextVar[Path | None] = ContextVar("_folder", default=None)  # folder of the cache, if any


@contextmanager
@checks_arguments
def tiles_kept_in(folder: str | Path) -> Iterator[None]:
    """Cache finished tiles in a folder until the block ends without an error, and use those that it has.

    Parameters
    ----------
    folder : str or Path
        Made with the first tile, and removed at the end of the block; an error, Ctrl-C or a kill leaves it. Tiles of
        other scenes, views or settings are ignored.

    Raises
    ------
    SarsplatError
        If it is a file, or holds other files than tiles.
    """
    folder = Path(folder)
    with plain_os_errors("read", folder):
        for path in folder.iterdir() if folder.exists() else ():
            if not re.fullmatch(r"[0-9a-f]{32}", path.name) or path.is_symlink():
                raise SarsplatError(f"{folder} holds {path.name}, which is not a tile; move it or choose another name")
    before = _folder.set(folder)
    try:
        yield
    finally:
        _folder.reset(before)
    shutil.rmtree(folder, ignore_errors=True)


class TileCache:
    """Cached tiles of one image, a file each; empty outside of `tiles_kept_in`.

    `settings` are all other values that the image depends on: tensors, and values with a complete `repr`.
    """

    def __init__(self, gaussians: Gaussians, *settings: object) -> None:
        folder = _folder.get()
        scene = (gaussians.scattering.settings(), *gaussians.tensors().values())
        self._folder = None if folder is None else folder / _digest(*scene, *settings)

    def find(self, tile: Tile) -> Float[Tensor, "c rows columns"] | None:
        """Image of a tile, or None."""
        if self._folder is None or not (path := self._path(tile)).is_file():
            return None
        with plain_os_errors("read", path):
            return torch.from_numpy(np.load(path, allow_pickle=False))

    def add(self, tile: Tile, image: Float[Tensor, "c rows columns"]) -> None:
        """Write the image of a tile; nothing without a folder."""
        if self._folder is None:
            return
        with plain_os_errors("write", self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
        buffer = io.BytesIO()
        np.save(buffer, image.numpy(), allow_pickle=False)
        write_bytes(self._path(tile), buffer.getvalue())

    def _path(self, tile: Tile) -> Path:
        assert self._folder is not None
        pixels = (tile.rows.start, tile.rows.stop, tile.columns.start, tile.columns.stop)
        return self._folder / f"{'-'.join(map(str, pixels))}.npy"


def _digest(*parts: object) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        if isinstance(part, Tensor):
            digest.update(part.detach().cpu().contiguous().numpy().data)
        else:
            digest.update(repr(part).encode())
    return digest.hexdigest()
