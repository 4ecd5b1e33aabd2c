"""ctypes mirrors of the structures in `csrc/api.h`, and the check that they are the compiled engine's."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import POINTER, c_char_p, c_double, c_float, c_int32, c_int64, c_void_p

from sarsplat.errors import SarsplatError


def structure(name: str, *fields: tuple[str, type]) -> type[ctypes.Structure]:
    """A C structure of these fields."""
    return type(name, (ctypes.Structure,), {"_fields_": list(fields)})


_PAIR = c_float * 2
Problem = structure(
    "sg_problem",
    *((name, c_int32) for name in ("peak", "views", "of_views", "gaussians")),
    *((name, c_int32) for name in ("coefficients", "channels", "rows", "columns")),
    *((name, c_void_p) for name in ("means", "quaternions", "scales", "kappa", "harmonics", "amplitudes")),
    *((name, c_void_p) for name in ("frames", "basis", "shift", "in_sight")),
    ("p_min", c_float),
    *((name, _PAIR) for name in ("pixel", "center", "response_var", "ray")),
    *((name, c_float) for name in ("cell_widening", "min_ray_depth", "min_transmittance", "image_cut")),
    *(
        (name, c_float)
        for name in ("min_scale", "max_scale", "max_depth", "farthest", "strongest", "flattest", "steepest")
    ),
)
Outputs = structure("sg_outputs", *((name, c_void_p) for name in ("images", "cross_sections", "lit_area")))
Gradients = structure(
    "sg_gradients",
    *((name, c_void_p) for name in ("images", "cross_sections", "transmittance")),
    *((name, c_void_p) for name in ("means", "quaternions", "scales", "kappa", "harmonics", "amplitudes")),
    *((name, c_void_p) for name in ("shift", "planes")),
)
Projection = structure(
    "sg_projection",
    *((name, c_void_p) for name in ("ray_centers", "ray_roots", "optical_depth", "range", "tilt")),
    *((name, c_void_p) for name in ("pixel_centers", "pixel_roots", "gamma0")),
)
Channels = structure(
    "sg_channels", ("count", c_int32), *((name, c_void_p) for name in ("cross_sections", "wavenumbers", "slopes"))
)
Lattice = structure("sg_lattice", ("k0x", c_int64), ("k0y", c_int64), ("rows", c_int32), ("columns", c_int32))
Statistics = structure(
    "sg_statistics",
    *((f"{what}_{plane}", c_int64) for plane in ("attenuation", "imaging") for what in ("blocks", "live")),
    ("lanes", c_int64),
)
Loss = structure(
    "sg_loss",
    *((name, c_int32) for name in ("views", "rows", "columns")),
    *((name, c_void_p) for name in ("power", "truth", "window")),
    *((name, c_float) for name in ("reference", "floor", "ssim_weight", "c1", "c2")),
    *((name, c_void_p) for name in ("loss", "gradient")),
)
Sections = structure(
    "sg_sections",
    *(("views", c_int32), ("pairs", c_int32), ("gaussians", c_int64), ("shared", c_int32)),
    *(
        (name, c_void_p)
        for name in ("means", "quaternions", "scales", "frames", "roots", "numbers", "real", "imaginary")
    ),
    *((name, c_void_p) for name in ("parts", "slopes", "d_parts", "d_slopes")),
    *((name, c_void_p) for name in ("d_means", "d_quaternions", "d_scales", "d_roots", "d_real", "d_imaginary")),
)
Lobes = structure(
    "sg_lobes",
    *(("views", c_int32), ("p_min", c_float), ("gaussians", c_int64)),
    *((name, c_void_p) for name in ("directions", "quaternions", "scales", "parameters")),
    *((name, c_void_p) for name in ("amplitudes", "d_amplitudes", "d_quaternions", "d_parameters")),
)
Likelihood = structure(
    "sg_likelihood",
    *((name, c_int32) for name in ("views", "rows", "columns", "passes", "powers", "pairs", "reach")),
    *((name, c_void_p) for name in ("power", "pair", "of_channels", "of_pairs", "phases", "noise", "truth", "loss")),
    *((name, c_void_p) for name in ("d_power", "d_pair", "d_phases", "d_noise", "failed")),
)
Axis = structure("sg_axis", ("first", c_double), ("step", c_double), ("count", c_int32))
Patches = structure("sg_patches", ("rows", Axis), ("columns", Axis))
Ground = structure(
    "sg_ground",
    ("views", c_int32),
    ("rows", Axis),
    ("columns", Axis),
    ("std", c_double * 2),
    ("patches", POINTER(Patches)),
    *((name, c_void_p) for name in ("transmittance", "shift", "lit", "d_lit", "d_transmittance", "d_shift")),
)
TerrainPatches = structure(
    "sg_terrain_patches",
    ("rows", c_int32),
    ("across", Axis),
    *((name, c_void_p) for name in ("low", "high")),
    *((name, c_int32 * 2) for name in ("traced_first", "traced")),
    *((name, c_float * 4) for name in ("x", "y")),
)
Terrain = structure(
    "sg_terrain",
    ("views", c_int32),
    ("rows", Axis),
    ("columns", Axis),
    ("std", c_double * 2),
    ("cell", c_double),
    ("places", c_int32 * 2),
    ("patches", POINTER(TerrainPatches)),
    *((name, c_void_p) for name in ("transmittance", "gamma0", "shift", "lit")),
    *((name, c_void_p) for name in ("d_lit", "d_transmittance", "d_gamma0", "d_shift")),
)
_COLUMNS = c_float * 16
AdamGroup = structure(
    "sg_adam_group",
    *((name, c_void_p) for name in ("value", "gradient", "mean", "square")),
    ("rows", c_int64),
    ("columns", c_int32),
    ("logarithmic", c_int32),
    ("decay", c_float),
    *((name, _COLUMNS) for name in ("rate", "low", "high")),
)
AdamStep = structure(
    "sg_adam_step",
    ("groups", POINTER(AdamGroup)),
    ("count", c_int32),
    *((name, c_float) for name in ("beta1", "beta2", "epsilon", "beta1_power", "beta2_power")),
)
MIRRORS = (
    Problem,
    Outputs,
    Gradients,
    Projection,
    Channels,
    Lattice,
    Statistics,
    Loss,
    Sections,
    Lobes,
    Likelihood,
    Axis,
    Patches,
    Ground,
    TerrainPatches,
    Terrain,
    AdamGroup,
    AdamStep,
)
"""Every structure that Python and the engine share."""


def _compiled(library: ctypes.CDLL, name: str, count: int) -> list[int] | None:
    try:
        layout = library.sg_layout
    except AttributeError:  # of a time before there were layouts
        return None
    layout.restype, layout.argtypes = POINTER(c_int32), [c_char_p]
    numbers = layout(name.encode())
    return numbers[:count] if numbers else None


def check_layouts(library: ctypes.CDLL, mirrors: Sequence[type[ctypes.Structure]] = MIRRORS) -> None:
    """Compare every structure's size and the offsets of its fields with what the engine was compiled with.

    Raises
    ------
    SarsplatError
        If one differs: the engine was built from other sources than this Python code.
    """
    for mirror in mirrors:
        numbers = [ctypes.sizeof(mirror), *(getattr(mirror, field[0]).offset for field in mirror._fields_), -1]
        if _compiled(library, mirror.__name__, len(numbers)) != numbers:
            raise SarsplatError(
                f"the compiled CPU engine has another layout of {mirror.__name__} than this version of sarsplat; "
                "reinstall with `pip install .`"
            )
