"""A triangle mesh as the radar sees it, softly: occlusion on a plane facing the radar, the image on azimuth × range.

After Fu & Xu, "Differentiable SAR renderer and image-based target reconstruction", IEEE TIP 2022; what was not
published is listed in docs/rivals-dsr.md.

The cross-section of a face is σ_f = γ⁰_f·A_f·max(cos i, 0)·v_f, with A_f its area, i the angle between its normal and
the direction to the radar and v_f in [0, 1] the share of it that the radar sees. It is shared between the pixels as the
face covers them on the mapping plane, so that ΣS·Δa·Δr = Σσ_f for faces that lie within the image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import conv2d, logsigmoid

from sarsplat.geometry import ImageGrid, View, radar_frame
from sarsplat.rivals.regularity import face_normals, gathered
from sarsplat.rivals.soft_raster import Coverage, Lattice, grouped_softmax, picked, soft_coverage

_GRAZED = 0.1
"""A face is a full part of the mask from this cosine of incidence on."""

_TAME = 0.1
"""Areas below this many σ, on the plane facing the radar, lose their slope: they are seen edge-on."""


@dataclass(frozen=True)
class Layers:
    """What the mesh does to an image.

    Attributes
    ----------
    target : Tensor [rows, columns]
        β⁰ of the lit faces in units of `Scene.unit`.
    lit : Tensor [rows, columns]
        Share of each pixel in which a lit face appears.
    hidden : Tensor [rows, columns]
        Share of each pixel's flat ground (z = 0) that the target hides from the radar.
    sections : Tensor [F]
        Radar cross-section of each face in m² times the unit.
    """

    target: Float[Tensor, "rows columns"]
    lit: Float[Tensor, "rows columns"]
    hidden: Float[Tensor, "rows columns"]
    sections: Float[Tensor, " f"]

    @property
    def shadow(self) -> Float[Tensor, "rows columns"]:
        """Hidden ground where no lit face appears."""
        return self.hidden * (1 - self.lit)


@dataclass(frozen=True)
class MeshRenderer:
    """Renders closed meshes on one grid.

    Parameters
    ----------
    grid : ImageGrid
        Where the pixels lie, and the response.
    softness_m : float
        √σ of the coverage on all planes, m.
    gamma_m : float
        How far a face may lie behind another and still be seen: e-fold in depth, m.
    """

    grid: ImageGrid
    softness_m: float
    gamma_m: float

    def layers(
        self, points: Float[Tensor, "n 3"], faces: Int64[Tensor, "f 3"], gamma0: Float[Tensor, " f"], view: View
    ) -> Layers:
        """What a mesh does to an image.

        Parameters
        ----------
        points : Tensor [N, 3]
            Vertices, m, world frame.
        faces : Tensor, int64 [F, 3]
            Triangles, counter-clockwise seen from outside; only from there they are seen.
        gamma0 : Tensor [F]
            γ⁰ of each: cross-section per area projected along the line of sight.
        view : View
            From where.

        Returns
        -------
        Layers
            Differentiable in `points` and `gamma0`.

        Raises
        ------
        SarsplatError
            If a vertex is not finite.
        """
        shape = (self.grid.rows, self.grid.columns)
        frame = torch.as_tensor(radar_frame(view), dtype=points.dtype, device=points.device)
        seen = points @ frame.T
        across, up, away = seen.unbind(1)
        normals = face_normals(seen, faces)
        areas = -normals[:, 2] / 2  # projected along the line of sight, m²; negative where turned away
        facing = torch.nonzero(areas.detach() > 0).reshape(-1)
        visible = self._visible(seen, faces[facing])
        sections = picked(gamma0 * areas, facing) * visible

        lattice = Lattice.of(self.grid)
        mapped = soft_coverage(_corners(across, away, faces[facing]), lattice, self.softness_m)
        power = picked(sections, mapped.face) * mapped.shares() / math.prod(self.grid.spacing_m)
        target = self._responded(mapped.onto_pixels(power).reshape(shape))
        cosine = picked(2 * areas / (normals.square().sum(1) + 1e-20).sqrt(), facing)
        lit = mapped.union(visible * (cosine / _GRAZED).clamp(max=1)).reshape(shape)

        # along its ray, a point's shadow reaches the ground at the range y_r / tan θ
        fallen = up / math.tan(math.radians(view.grazing_deg))
        shaded = soft_coverage(_corners(across, fallen, faces[facing]), lattice, self.softness_m)
        hidden = shaded.union().reshape(shape)
        return Layers(target, lit, hidden, torch.zeros_like(areas).index_add(0, facing, sections))

    def _visible(self, seen: Float[Tensor, "n 3"], faces: Int64[Tensor, "f 3"]) -> Float[Tensor, " f"]:
        """Share of each face turned to the radar that it sees, on the plane facing it.

        On a closed surface those turned away lie behind others, and hide nothing.
        """
        if len(faces) == 0:
            return seen.new_zeros(0)
        lattice = Lattice.around(seen[:, :2], min(self.grid.spacing_m))
        plane = soft_coverage(_corners(seen[:, 0], seen[:, 1], faces), lattice, self.softness_m)
        level, nearest, farthest, slope = self._depths(seen, faces, plane, lattice)
        covered = logsigmoid(plane.signed)
        # beside its outline a face's plane goes on, but never nearer to the radar as what hides, nor farther as what is
        # hidden: else faces seen at a slant would hide those behind them on the same surface
        hiding, own = torch.maximum(level, nearest), torch.minimum(level, farthest)
        weight = grouped_softmax(covered - hiding / self.gamma_m, plane.pixel, plane.pixels + 1)
        front = picked(torch.cat([plane.onto_pixels(weight * hiding), level.new_zeros(1)]), plane.pixel)
        # a face that slopes away lies behind its own neighbours by as much as edges are soft
        allowed = self.gamma_m + picked(slope, plane.face) * self.softness_m
        seen_through = torch.exp(-((own - front - allowed) / self.gamma_m).clamp(min=0))
        within = covered.masked_fill(plane.pixel == plane.pixels, -math.inf)  # every face has a pixel on the lattice
        return plane.onto_faces(grouped_softmax(within, plane.face, plane.faces) * seen_through)

    def _depths(
        self,
        seen: Float[Tensor, "n 3"],
        faces: Int64[Tensor, "f 3"],
        plane: Coverage,
        lattice: Lattice,
    ) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"], Float[Tensor, " p"], Float[Tensor, " f"]]:
        """Range of the faces' planes at their pixels, of their nearest and of their farthest corner, m; their slopes."""
        face, pixel = plane.face, plane.pixel
        a, b, c = (gathered(seen, faces[:, k]) for k in range(3))
        first, second = b - a, c - a
        area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
        inverse = area / (area**2 + (_TAME * self.softness_m**2) ** 2)  # tame where a face is seen edge-on
        slope_x = (first[:, 2] * second[:, 1] - second[:, 2] * first[:, 1]) * inverse
        slope_y = (second[:, 2] * first[:, 0] - first[:, 2] * second[:, 0]) * inverse
        middle = (a + b + c) / 3
        depths = torch.stack([a[:, 2], b[:, 2], c[:, 2]])
        column = (pixel % lattice.columns).to(seen.dtype)
        row = torch.div(pixel, lattice.columns, rounding_mode="floor").to(seen.dtype)
        across = column * lattice.step_m[0] + lattice.first_m[0] - picked(middle[:, 0], face)
        along = row * lattice.step_m[1] + lattice.first_m[1] - picked(middle[:, 1], face)
        level = picked(middle[:, 2], face) + picked(slope_x, face) * across + picked(slope_y, face) * along
        steepness = (slope_x**2 + slope_y**2 + 1e-12).sqrt()
        return level, picked(depths.amin(0), face), picked(depths.amax(0), face), steepness

    def _responded(self, power: Float[Tensor, "rows columns"]) -> Float[Tensor, "rows columns"]:
        """Seen through what the system's response is wider than soft edges."""
        grid = self.grid
        for axis in range(2):
            variance = grid.resolution_m[axis] ** 2 / (8 * math.log(2)) - self.softness_m**2
            if variance <= 0:
                continue
            reach = math.ceil(4 * math.sqrt(variance) / grid.spacing_m[axis])
            offsets = torch.arange(-reach, reach + 1, dtype=power.dtype, device=power.device) * grid.spacing_m[axis]
            kernel = torch.exp(-(offsets**2) / (2 * variance))
            kernel = (kernel / kernel.sum()).reshape((1, 1, 1, -1) if axis == 0 else (1, 1, -1, 1))
            padding = (0, reach) if axis == 0 else (reach, 0)
            power = conv2d(power[None, None], kernel, padding=padding)[0, 0]
        return power


def _corners(
    across: Float[Tensor, " n"], along: Float[Tensor, " n"], faces: Int64[Tensor, "f 3"]
) -> Float[Tensor, "f 3 2"]:
    index = faces.reshape(-1)
    return torch.stack([picked(across, index), picked(along, index)], dim=1).reshape(-1, 3, 2)
