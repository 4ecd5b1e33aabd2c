"""Installed packages: versions, and optional dependencies (extras) with the types that annotations need of them."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NewType

from sarsplat.errors import SarsplatError

if TYPE_CHECKING:
    from trimesh import Trimesh as Trimesh
else:
    Trimesh = NewType("Trimesh", object)  # arguments are checked by this name

_DISTRIBUTIONS = {
    "PIL": "pillow",
    "cv2": "opencv-python-headless",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
}
"""Module → distribution, where the names differ."""

_MODULES = {
    "simulate": "trimesh mapbox_earcut embreex",
    "mesh": "trimesh skimage",
    "mstar": "PIL",
    "evaluate": "sklearn skimage trimesh embreex fcpw",
    "baselines": "trimesh skimage embreex",
    "view": "viser websockets matplotlib trimesh fcpw",
    "report": "matplotlib jinja2 trimesh skimage",
    "sicd": "sarkit jbpy lxml",
    "rslc": "h5py",
    "phase-history": "finufft sarkit lxml",
    "gis": "pyproj rasterio",
    "las": "laspy lazrs pyproj",
    "video": "PIL cv2",
    "tensorboard": "tensorboard",
    "ray": "ray",
}
EXTRAS = {
    extra: {module: _DISTRIBUTIONS.get(module, module) for module in modules.split()}
    for extra, modules in _MODULES.items()
}
"""Extra → its modules → their distributions."""


def install_command(extra: str) -> str:
    """Return the sentence on installing an extra; by its packages if sarsplat itself is not installed."""
    if installed_version("sarsplat") is None:
        return f"install it with: pip install {' '.join(EXTRAS[extra].values())}"
    return f"install it with: pip install 'sarsplat[{extra}]'"


@contextmanager
def needed(extra: str, purpose: str) -> Iterator[None]:
    """Raise with the way to install an extra, which a purpose needs, if a package imported inside is missing."""
    try:
        yield
    except ImportError as error:
        package = _DISTRIBUTIONS.get(error.name or extra, error.name or extra)
        raise SarsplatError(f"{purpose} needs {package}, which is not installed; {install_command(extra)}") from error


def installed_version(distribution: str) -> str | None:
    """Return the version of an installed distribution, or None."""
    from importlib.metadata import PackageNotFoundError, version  # here, because help does not need it

    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def program_version() -> str:
    """Return the version of this program, which output files record."""
    return installed_version("sarsplat") or "from source"
