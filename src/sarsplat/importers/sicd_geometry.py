"""Positions of the ground around a spot in a SICD, and the view of the radar.

The world frame is level at the spot: z up, and x towards a compass heading, east unless stated otherwise. A pixel of a
SICD is a range and a range rate of one antenna position, whatever plane its rows and columns span, so a place on the
ground is found in it by sarkit's projection, not by angles between axes. A view has parallel rays and a level azimuth
axis x_r, with which resampled level ground agrees exactly. Heights agree too if the radar's velocity across the line of
sight is level; otherwise (the radar squints or climbs) the slant plane is tilted about the line of sight, and a height
of one metre is displaced by `leaning` metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from sarsplat.errors import SarsplatError
from sarsplat.geometry import Place, View
from sarsplat.importers.files import check_pixel
from sarsplat.importers.sarkit_xml import sarkit_errors
from sarsplat.importers.sicd_file import Sicd

_LATTICE = 9  # places to a side that a layout is fitted to
_DEGREE = 3  # of the polynomials that are fitted
_FINE = 1e-5  # m: tolerance of a computed position
_BENT = 0.02  # pixels: how far a layout may be from its fit
_STEEPEST_TILT_DEG = 60.0
_ASTRAY_CELLS = 20.0  # far more than rounding, and what polynomials are fitted to
_DIGITS = 9  # of angles in degrees: what is left is rounding


@dataclass(frozen=True)
class Layout:
    """Layout of level ground around the spot in an image."""

    view: View
    look: str
    """Side of the radar's track on which the spot is, "left" or "right"."""
    distance_m: float
    """Distance from the radar to the spot."""
    tilt_deg: float
    """Tilt of the slant plane about the line of sight, of a radar that looks right; also that of a tilted view."""
    extent_m: float
    """Half a side of the square that the fit is for."""
    coefficients: Float64[np.ndarray, "n 2"]
    """Coefficients of the polynomials from (azimuth, range), in units of `extent_m`, to (xrow, ycol), m."""
    leaning: tuple[float, float] = (0.0, 0.0)
    """Displacement (azimuth, range) of heights against the view's parallel rays, m for each metre."""

    def place_of(
        self, azimuth_m: Float64[np.ndarray, "*n"], range_m: Float64[np.ndarray, "*n"]
    ) -> Float64[np.ndarray, "*n 2"]:
        """Convert (azimuth, slant range) of the view, m, to (xrow, ycol), m."""
        return _terms(azimuth_m / self.extent_m, range_m / self.extent_m) @ self.coefficients

    @property
    def slopes(self) -> Float64[np.ndarray, "2 2"]:
        """Derivatives of (xrow, ycol) with respect to (azimuth, range) at the spot: rows are xrow and ycol."""
        step = 1e-3 * self.extent_m
        ahead = self.place_of(np.array([step, 0.0]), np.array([0.0, step]))
        return (ahead - self.place_of(np.zeros(1), np.zeros(1))).T / step


def middle_of(sicd: Sicd) -> str:
    """Return arguments for the middle of an image."""
    row, column = (size // 2 for size in sicd.shape)
    spot = spot_of_pixel(sicd, (row, column), 90.0)
    return (
        f"the middle of {sicd.path.name} is `pixel=({row}, {column})`, or "
        f"`around=({spot.latitude_deg:.6f}, {spot.longitude_deg:.6f}, {spot.height_m:.1f})`"
    )


def spot_of_pixel(sicd: Sicd, pixel: tuple[float, float], heading_deg: float) -> Place:
    """Return the place of a pixel on the ground, at the height of the scene centre point.

    Raises if the pixel is outside the image or shows no such place.
    """
    from sarkit import wgs84

    check_pixel(sicd.path, pixel, sicd.shape)
    with sarkit_errors(sicd.path):
        ground = _ground_of(sicd, sicd.place_of(np.array(pixel, float)), corrected=True)
        latitude, longitude, height = map(float, wgs84.cartesian_to_geodetic(ground))
    if not all(map(math.isfinite, (latitude, longitude, height))):
        raise SarsplatError(f"the pixel {pixel[0]:g}, {pixel[1]:g} of {sicd.path} shows no place on the ground")
    return Place(latitude, longitude, height, heading_deg)


def _ground_of(sicd: Sicd, place: Float64[np.ndarray, " 2"], *, corrected: bool) -> Float64[np.ndarray, " 3"]:
    """Project (xrow, ycol) to the ground at the height of the scene centre point: ECEF, m."""
    from sarkit.sicd import projection

    metadata = sicd.projection
    seen = projection.compute_projection_sets(metadata, place)
    if corrected and sicd.offsets is not None:
        seen = projection.apply_apos(metadata, seen, sicd.offsets)
    ground, _, _ = projection.r_rdot_to_constant_hae_surface(
        metadata.LOOK, metadata.SCP, seen, metadata.SCP_HAE, delta_hae_max=1e-3, nlim=20
    )
    return np.asarray(np.squeeze(ground), np.float64)


def said_of_place(sicd: Sicd) -> str | None:
    """Return a warning if a file contradicts its own scene centre point; otherwise None."""
    with sarkit_errors(sicd.path):
        astray = float(np.linalg.norm(_ground_of(sicd, np.zeros(2), corrected=False) - sicd.projection.SCP))
    cell = max(axis.resolution_m for axis in sicd.axes)
    if not astray > _ASTRAY_CELLS * cell:  # NaN is rejected where the ground is needed
        return None
    return (
        f"{sicd.path.name} contradicts itself: its scene centre point is {astray:.4g} m from where its own projection "
        "has that pixel, so places on earth are wrong by as much; get it again, by another converter"
    )


def layout_around(sicd: Sicd, spot: Place, extent_m: float, *, tilted: bool = False) -> Layout:
    """Return the layout of the ground up to `extent_m` from the spot, in azimuth and slant range.

    The azimuth axis of the view is level, or `tilted` as the image's own. Raises if the image does not show the spot,
    the radar is below its horizon, metadata are contradictory, or the slant plane is tilted by more than 60°.
    """
    with sarkit_errors(sicd.path):
        place = _locate(sicd, spot, np.zeros((1, 3)))
        antenna, moves = antenna_at(sicd, place[0])
        line, velocity = spot.axes @ (antenna - spot.ecef), spot.axes @ moves
        distance = float(np.linalg.norm(line))
        toward = line / distance
        if not toward[2] > 0:  # also catches NaN
            raise SarsplatError(f"the radar of {sicd.path} is below the horizon of the spot; {middle_of(sicd)}")
        exact = View.towards(toward)
        view = View(round(exact.azimuth_deg, _DIGITS) % 360, round(exact.grazing_deg, _DIGITS))
        frame = view.look.frame
        across = frame @ (velocity - (velocity @ toward) * toward)  # range component 0
        tilt = math.degrees(math.atan2(across[1], abs(across[0])))
        tilt = math.copysign(tilt, tilt * across[0])
        look = "right" if across[0] > 0 else "left"
        if not abs(tilt) <= _STEEPEST_TILT_DEG:
            raise SarsplatError(
                f"{sicd.path} has a slant plane that is tilted by {tilt:.0f}° about the line of sight, because its "
                f"radar looks ahead or back or climbs; at most {_STEEPEST_TILT_DEG:g}° is supported, so leave it out"
            )
        if tilted:
            view = replace(view, tilt_deg=round(tilt, _DIGITS))
        layout = Layout(view, look, distance, tilt, extent_m, _fit(sicd, spot, view, extent_m))
        return replace(layout, leaning=_leaning(sicd, spot, layout))


def _locate(sicd: Sicd, spot: Place, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
    """Project places in the world frame to (xrow, ycol)."""
    from sarkit.sicd import projection

    places, _, ground = projection.scene_to_image(
        sicd.projection, spot.to_ecef(points), adjust_param_offsets=sicd.offsets, delta_gp_s2i=_FINE, maxiter=30
    )
    if not ground or not np.isfinite(places).all():
        raise SarsplatError(
            f"{sicd.path} does not show the spot {spot.latitude_deg:.6f}, {spot.longitude_deg:.6f}; {middle_of(sicd)}"
        )
    return places


def antenna_at(
    sicd: Sicd, place: Float64[np.ndarray, "*n 2"]
) -> tuple[Float64[np.ndarray, "*n 3"], Float64[np.ndarray, "*n 3"]]:
    """Return position and velocity of the antenna (ECEF, m) at the aperture centre of each place (xrow, ycol)."""
    from sarkit.sicd import projection

    with sarkit_errors(sicd.path):
        time = projection.compute_coa_time(sicd.projection.cT_COA, place)
        state = projection.compute_coa_pos_vel(sicd.projection, time)
    assert isinstance(state, projection.CoaPosVelsMono)  # read_sicd refuses others
    return np.asarray(state.ARP_COA, np.float64), np.asarray(state.VARP_COA, np.float64)


def on_ground(view: View, azimuth_m: np.ndarray, range_m: np.ndarray) -> Float64[np.ndarray, "n 3"]:
    """Return the points on level ground at these azimuths and ranges of a view."""
    across, elevation, away = view.look.frame
    rise = -away[2] / elevation[2]  # along the elevation axis for each metre of range
    across = across - view.look.lean * elevation
    return np.outer(azimuth_m, across) + np.outer(range_m, away + rise * elevation)


def _fit(sicd: Sicd, spot: Place, view: View, extent_m: float) -> Float64[np.ndarray, "n 2"]:
    steps = np.linspace(-1, 1, _LATTICE)
    azimuth, away = (part.ravel() for part in np.meshgrid(steps, steps))
    places = _locate(sicd, spot, on_ground(view, azimuth * extent_m, away * extent_m))
    terms = _terms(azimuth, away)
    coefficients = np.linalg.lstsq(terms, places, rcond=None)[0]
    left = np.abs(terms @ coefficients - places) / [sicd.row.spacing_m, sicd.column.spacing_m]
    if left.max() > _BENT:
        raise SarsplatError(
            f"{sicd.path} bends so much around the spot that {left.max():.2f} pixels are left unexplained; give a "
            "smaller size"
        )
    return coefficients


def _terms(azimuth: Float64[np.ndarray, "*n"], away: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n terms"]:
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    return np.stack([azimuth**i * away**j for i, j in powers], axis=-1)


def _leaning(sicd: Sicd, spot: Place, layout: Layout) -> tuple[float, float]:
    height = max(1.0, layout.extent_m / 16)
    top = np.array([[0.0, 0.0, height]])
    seen = np.linalg.solve(layout.slopes, (_locate(sicd, spot, top) - _locate(sicd, spot, 0 * top))[0])
    azimuth, away = layout.view.look.gradients @ top[0]
    return float((seen[0] - azimuth) / height), float((seen[1] - away) / height)
