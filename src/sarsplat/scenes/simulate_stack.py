"""Simulation of the signals of a stack from point scatterers; shares no code with the renderer.

Points with random complex amplitudes are placed at the first hits of rays on mesh or ground. Every pass sums the same
points through the amplitude response, with the phase of their distance in that pass; this produces speckle, layover,
shadow and decorrelation.
"""

import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Complex64, Complex128, Float64

from sarsplat.arguments import check_number, checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.extras import Trimesh
from sarsplat.geometry import ImageGrid, Stack, View
from sarsplat.geometry.stack import LOUDEST
from sarsplat.geometry.view import check_unstretched
from sarsplat.scenes._rays import Facets, Region, tracer
from sarsplat.scenes.mechanisms import Mechanisms
from sarsplat.scenes.placement import warn_below_ground
from sarsplat.scenes.raycast import check_rays
from sarsplat.scenes.scattering import ScatteringLaw, generator

_PER_CELL = 8  # scatterers along each side of a resolution cell: their sum is speckle to a few per cent
_NODES = 5  # nodes per pixel and axis on which points are summed: phases are exact, positions to a tenth of a pixel
_REACH = 8.0  # reach of the response, 3 dB widths; side lobes beyond are left out
_BATCH = 1 << 19  # rays at once


@checks_arguments
def simulate_stack(
    mesh: Trimesh,
    view: View,
    grid: ImageGrid,
    stack: Stack,
    law: ScatteringLaw,
    *,
    ground_gamma0: float | None = None,
    mechanisms: Mechanisms | None = None,
    noise: float = 0.0,
    seed: int = 0,
    spacing_m: float | None = None,
) -> Complex64[np.ndarray, "p {grid.rows} {grid.columns}"]:
    """Simulate single-look complex images of every channel of a mesh: passes or polarisations.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Opaque triangles, m.
    view, grid, stack
        Direction to the radar, pixels, and the channels, which are coregistered to them.
    law, ground_gamma0
        As for `simulate_raycast`.
    mechanisms : Mechanisms, optional
        Polarimetric covariances, for stacks of several polarisations.
    noise : float
        Power of the independent noise of each pass, β⁰.
    seed : int
        Seed of the scatterers and the noise, at least 0.
    spacing_m : float, optional
        Mean distance between scatterers across the line of sight; an eighth of the finer resolution unless given.

    Returns
    -------
    numpy.ndarray, complex64 [P, rows, columns]
        √β⁰·e^jψ, not deramped (`Stack.plane_phases`); E[y_i y_j*] is what `render_covariances` renders of the scene.

    Raises
    ------
    SarsplatError
        If the mesh has no faces or is not finite, a setting is out of range, or mechanisms are missing or do not fit.

    Warns
    -----
    SarsplatWarning
        If a good part of the mesh is below the ground.
    """
    check_unstretched([view])
    roots = _roots(mechanisms, stack, len(mesh.faces))
    spacing = min(grid.resolution_m) / _PER_CELL if spacing_m is None else spacing_m
    check_rays(mesh, ground_gamma0, spacing, (0.5, 0.5))
    check_number("`noise`", noise, 0, LOUDEST)
    warn_below_ground(mesh, grid, ground_gamma0, None)
    rng = generator(seed, "scatterers")
    facets, look = Facets.of(mesh, view), view.look
    gamma0 = np.append(law.gamma0(facets.cos_incidence), ground_gamma0 or 0.0)  # the last is the ground's
    trace, vectors = tracer(facets), stack.phase_vectors(view) @ look.frame.T  # in the radar frame
    axes, names = (_Axis(grid, 0), _Axis(grid, 1)), [*dict.fromkeys(stack.of_channels)]
    nodes = np.zeros((len(stack), axes[1].count, axes[0].count), np.complex128)
    for position in _scattered(_region(facets, axes, ground_gamma0, view), spacing, rng):
        face = trace(position)
        depth = np.where(face >= 0, facets.depth(face.clip(0), position), np.inf)
        if ground_gamma0 is not None:
            of_ground = look.range_on_ground(*position.T)
            face, depth = np.where(depth < of_ground, face, -1), np.minimum(depth, of_ground)
        hit = np.isfinite(depth)
        point, face = np.column_stack([position, depth])[hit], face[hit]
        white = rng.standard_normal((2, len(face) * roots.shape[1])).T @ [1, 1j]
        drawn = np.einsum("kij,kj->ki", roots[face], white.reshape(len(face), -1))  # E[a aᴴ] = 2 L Lᴴ
        amplitude = np.sqrt(gamma0[face] * spacing**2 / 2)[:, None] * drawn
        row, column = axes[1].nearest(point[:, 2]), axes[0].nearest(point[:, 0])
        inside = (row >= 0) & (row < axes[1].count) & (column >= 0) & (column < axes[0].count)
        node = (row * axes[0].count + column)[inside]
        for total, vector, polarisation in zip(nodes, vectors, stack.of_channels, strict=True):
            signal = (amplitude[:, names.index(polarisation)] * np.exp(1j * point @ vector))[inside]
            real, imaginary = (np.bincount(node, part, total.size) for part in (signal.real, signal.imag))
            total += (real + 1j * imaginary).reshape(total.shape)
    images = axes[1].response @ nodes @ axes[0].response.T
    images += math.sqrt(noise / 2) * (rng.standard_normal((*images.shape, 2)) @ [1, 1j])
    return images.astype(np.complex64)


def _roots(mechanisms: Mechanisms | None, stack: Stack, faces: int) -> Complex128[np.ndarray, "f p p"]:
    """Return L of each facet and, at the end, of the ground, with E[a aᴴ] = γ⁰ L Lᴴ."""
    if not stack.polarimetric:
        return np.ones((faces + 1, 1, 1), np.complex128)
    given = None if mechanisms is None else (len(mechanisms.of_faces), *mechanisms.polarisations)
    needed = faces, *dict.fromkeys(stack.of_channels)
    if mechanisms is None or given != needed:
        raise SarsplatError(f"mechanisms (facets, polarisations) are {given}, but the stack needs {needed}")
    return mechanisms.roots


class _Axis:
    """Nodes along azimuth (0) or slant range (1), and the amplitude response from nodes to pixels."""

    def __init__(self, grid: ImageGrid, axis: int) -> None:
        pixels = (grid.azimuth_m, grid.range_m)[axis]
        spacing, width = grid.spacing_m[axis], grid.resolution_m[axis]
        self.step = spacing / _NODES
        margin = math.ceil(_REACH * width / self.step)
        self.first = float(pixels[0]) - margin * self.step
        self.count = (len(pixels) - 1) * _NODES + 1 + 2 * margin
        self.reach = self.first, self.first + (self.count - 1) * self.step
        distance = np.subtract.outer(pixels, self.first + self.step * np.arange(self.count)) / width
        norm = math.sqrt(float(grid.response.density(np.zeros(1))[0]))  # the square of the amplitude integrates to 1
        self.response = grid.response.amplitude(distance) * norm / math.sqrt(width)

    def nearest(self, position: Float64[np.ndarray, " k"]) -> np.ndarray:
        """Return the index of the node nearest to each position, possibly beyond both ends."""
        return np.rint((position - self.first) / self.step).astype(np.int64)


def _region(facets: Facets, axes: tuple[_Axis, _Axis], ground_gamma0: float | None, view: View) -> Region:
    """Return the region of rays that hit mesh or ground within the image."""
    lower, upper = facets.vertices.min(axis=0), facets.vertices.max(axis=0)
    low, high = [lower[0], lower[1]], [upper[0], upper[1]]
    if ground_gamma0 is not None:
        azimuths, ranges = axes[0].reach, axes[1].reach
        ground = [view.look.elevation_on_ground(x, r) for x in azimuths for r in ranges]
        low, high = [azimuths[0], min(low[1], *ground)], [azimuths[1], max(high[1], *ground)]
    return Region((max(low[0], axes[0].reach[0]), min(high[0], axes[0].reach[1])), (float(low[1]), float(high[1])))


def _scattered(region: Region, spacing: float, rng: np.random.Generator) -> Iterator[Float64[np.ndarray, "k 2"]]:
    """Draw one point at random in each square of a region, in batches."""
    if region.empty:
        return
    region.check(spacing, 1)
    columns, rows = (math.ceil((high - low) / spacing) for low, high in (region.x, region.y))
    rows_per_batch = max(1, _BATCH // columns)
    for first in range(0, rows, rows_per_batch):
        count = min(rows_per_batch, rows - first)
        u = np.arange(columns) + rng.random((count, columns))
        v = first + np.arange(count)[:, None] + rng.random((count, columns))
        yield np.column_stack([region.x[0] + spacing * u.ravel(), region.y[0] + spacing * v.ravel()])
