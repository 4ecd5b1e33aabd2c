"""Colours with a meaning, shared by report, viewer, figures and exports.

Ramps are legible on light and dark pages and for colour-blind readers. Their names are those below, or those of colour
maps in matplotlib.
"""

import base64
import zlib
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from sarsplat.errors import SarsplatError, shown
from sarsplat.extras import needed

if TYPE_CHECKING:
    from matplotlib.colors import Colormap

Palette = UInt8[np.ndarray, "256 4"]
"""Red, green, blue and opacity of 256 indices."""

# ---- ramps: their names ----------------------------------------------------------------------------------------------
POWER = "gray"
"""Power in decibels: dark is weak."""

POWER_RAMPS = (POWER, "cividis", "viridis", "inferno", "magma")
"""Ramps of even brightness that readers may choose for power."""

HEIGHT = "height"
"""Height z, from blue (low) to yellow (high), visible against white and against black."""

ERROR = "error"
"""Distance to the true surface, or another unsigned error: grey is 0."""

DIFFERENCE = "difference"
"""Signed errors: opacity rises with the error; zero is transparent."""

STRENGTH = "inferno"
"""γ⁰ of points in the world, on a dark background."""

INCIDENCE, SPREAD = "cividis", "inferno"
"""Radar maps: local incidence angle, and spread of a pixel's scatterers along elevation."""

PHASE = "twilight"
"""Phases: −π and π have the same colour."""

COHERENCE = "viridis"
"""Coherence, from 0 to 1."""

TOO_DARK, TOO_BRIGHT = "#8f6be0", "#e66101"
DIFFERENCE_IN_WORDS = "orange: too bright, purple: too dark"

_STOPS = {
    POWER: ("#000000", "#ffffff"),
    HEIGHT: ("#4b5bbf", "#2a9d8f", "#d9a01b"),
    ERROR: ("#7f8fa3", "#e69f00", "#c51b7d"),
}
_LISTED = {
    "cividis": (
        "c-oCp0TO^92m|ybJ*fY`MiW5;#j7#KtPU>}AOz-=Qz8LMC~@csu(_o|`0~&r2K{(Un<G<L+K*nk893UNFaH;(4yG)2%Y)gipR5@l"
        "e9V+?<nv{!@JY7;K<)RSPEmbpcx}8vCz^w}e(oDD`<v{vGDFy8rih@Z6b?ok2t7^bLmv"
    ),
    "viridis": (
        "c-n<hi4lY#3{0@KE8+St<xsL4Sjp&Rzu+jyOg`opECkc)X`Q6qnhK3HNo_OG;RhV>kb4UegZDb1pdhW1hA(9608i7%o<`5u+O6#W"
        "6MI|R-q~_nLKyo3Fq1@l=e3($blyl0DjP1z=#&|HsQxfvb9OjPgHv1mpkyG8q{bp%?-(;)vb7T{kBAB"
    ),
    "inferno": (
        "c-nnYff9uv2!rhX{~u?`HW6PJ%pqLTG0e>d{DJHs!U>Qs;e$R4<q|F;;(*eOB!nkOv@Yrca*^RRewRH^w6*urP6u^geWN|pynv!x"
        "9d(YM%G6!t7O)v|#%cbNLw)LdoUU&gNobki>0F5>sw(}<pOS}zaOtF1yLP_vOejQK(?U6N(<p5Kb`Gcg5T42nM;>jU"
    ),
    "magma": (
        "c-nnZ0TRO?2ov1@zwB-SL$G!b1Lv7mfnj3+W>_$1*l-6$vculB^q1sG_f&LnT*IwwB;bXl<Uh79*?xVvf`0)m>K0|9YP!<*pnj$W"
        "Ho~<BT6(W=N!o!IuJjWh_vy5m1SCzK_+2Be79*q0Xg#o_&`SykB*7c7NQn@fO{<x$$z{pxF?9O+h+oRdEx7"
    ),
}
"""Ramps of matplotlib, which is slow to import: compressed differences of red, green and blue."""

_OPACITY_EXPONENT = 1.5  # small differences are disproportionately faint


# ---- classes ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Page:
    """Colours of a page: background, panels, text, lines, training and test sets."""

    ground: str
    card: str
    ink: str
    muted: str
    line: str
    train: str
    test: str


LIGHT = Page("#f6f7f9", "#ffffff", "#17202b", "#55626f", "#dfe4ea", "#0a6fb8", "#b45309")
DARK = Page("#0b0f14", "#10151c", "#e3e9f1", "#9aa8b9", "#2a3441", "#5cc8ff", "#ffb454")

TARGET, SHADOW, LAYOVER = "#ffb454", "#5cc8ff", "#d6569c"
"""Classes of pixels, outlined on images and filled in radar maps."""

TRUE, PREDICTED = "#0b84d8", "#e66101"
"""Outlines of true and predicted masks."""

RADAR, PICKED = "#ff5c46", "#c8f04a"
"""The radar in the viewer, and the picked pixel with its contributors."""


@cache
def ramp(name: str) -> Palette:
    """Return the 256 colours of a ramp or of a colour map of matplotlib; raise for unknown names."""
    if name == DIFFERENCE:
        signed = np.linspace(-1, 1, 256)[:, None]
        colours = np.where(signed < 0, rgb(TOO_DARK), rgb(TOO_BRIGHT))
        return np.concatenate([colours, 255 * np.abs(signed) ** _OPACITY_EXPONENT], axis=1).round().astype(np.uint8)
    if name in _STOPS:
        corners = np.array([rgb(stop) for stop in _STOPS[name]], dtype=float)
        places = np.linspace(0, len(corners) - 1, 256)
        channels = [np.interp(places, np.arange(len(corners)), channel) for channel in corners.T]
        return np.stack([*channels, np.full(256, 255.0)], axis=1).round().astype(np.uint8)
    if name in _LISTED:
        steps = np.frombuffer(zlib.decompress(base64.b85decode(_LISTED[name])), np.uint8).reshape(3, 256)
        return np.concatenate([np.cumsum(steps, axis=1, dtype=np.uint8), np.full((1, 256), 255, np.uint8)]).T.copy()
    with needed("report", f"the colour map {shown(name)}"):
        from matplotlib import colormaps
    if name not in colormaps:
        raise SarsplatError(
            f"there is no colour map {shown(name)}; choose gray, viridis, magma, cividis, turbo or another from "
            "matplotlib"
        )
    return np.round(255 * colormaps[name](np.linspace(0, 1, 256))).astype(np.uint8)


def hollow(name: str) -> Palette:
    """Return the ramp with index 0 transparent, for pixels without data."""
    colours = ramp(name).copy()
    colours[0, 3] = 0
    return colours


def over(name: str, background: str) -> UInt8[np.ndarray, "256 3"]:
    """Return the ramp blended with a background."""
    opacity: Float[np.ndarray, "256 1"] = ramp(name)[:, 3:] / 255
    return np.round(ramp(name)[:, :3] * opacity + np.array(rgb(background)) * (1 - opacity)).astype(np.uint8)


def gradient(name: str) -> str:
    """Return the ramp as a CSS gradient from left to right."""
    stops = ramp(name)[np.linspace(0, 255, 9).astype(int)].tolist()
    return f"linear-gradient(90deg, {', '.join(f'rgb({r} {g} {b} / {a / 255:.2f})' for r, g, b, a in stops)})"


def colormap(name: str) -> "Colormap":
    """Return the ramp as a colour map of matplotlib."""
    from matplotlib.colors import ListedColormap

    return ListedColormap(ramp(name) / 255, name)


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of `#rrggbb`."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue
