"""Optional dependencies (extras): which there are, and how to install them."""

from __future__ import annotations

EXTRAS: dict[str, dict[str, str]] = {
    "simulate": {"trimesh": "trimesh", "embreex": "embreex"},
    "mesh": {"trimesh": "trimesh", "skimage": "scikit-image"},
    "mstar": {"PIL": "pillow"},
    "evaluate": {
        "sklearn": "scikit-learn",
        "skimage": "scikit-image",
        "trimesh": "trimesh",
        "embreex": "embreex",
        "fcpw": "fcpw",
    },
    "baselines": {"trimesh": "trimesh", "skimage": "scikit-image", "embreex": "embreex"},
    "view": {
        "viser": "viser",
        "websockets": "websockets",
        "matplotlib": "matplotlib",
        "trimesh": "trimesh",
        "fcpw": "fcpw",
    },
    "report": {"matplotlib": "matplotlib", "jinja2": "jinja2", "trimesh": "trimesh", "skimage": "scikit-image"},
    "sicd": {"sarkit": "sarkit", "lxml": "lxml"},
    "rslc": {"h5py": "h5py"},
    "phase-history": {"finufft": "finufft"},
    "las": {"laspy": "laspy", "lazrs": "lazrs"},
    "video": {"PIL": "pillow", "cv2": "opencv-python-headless"},
    "tensorboard": {"tensorboard": "tensorboard"},
    "ray": {"ray": "ray"},
}
"""Extra → modules it brings → names of their distributions."""


def extra_with(module: str) -> str | None:
    """The extra that brings a module, or None."""
    root = module.partition(".")[0]
    return next((extra for extra, modules in EXTRAS.items() if root in modules), None)


def install_command(extra: str) -> str:
    """What to type to get an extra."""
    return f"install it with: pip install 'sarsplat[{extra}]'"


def installed_version(distribution: str) -> str | None:
    """Version of an installed distribution, or None."""
    from importlib.metadata import PackageNotFoundError, version  # here, because help does without it

    try:
        return version(distribution)
    except PackageNotFoundError:
        return None
