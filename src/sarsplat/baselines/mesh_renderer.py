"""DSR's differentiable renderer of meshes: soft occlusion facing the radar, soft image on azimuth × slant range.

docs/concepts/baselines-dsr.md has the equations, published or not.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import logsigmoid

from sarsplat.baselines.meshes import face_normals, gathered
from sarsplat.baselines.soft_raster import Coverage, Lattice, grouped_softmax, picked, soft_coverage
from sarsplat.geometry import ImageGrid, View

_GRAZED = 0.1  # cosine of incidence from which a face counts fully in the mask
_TAME = 0.1  # projected area, in units of σ, below which a face's depth slope is damped: it is seen edge-on
_MOST_PARTS = 4  # maximum number of the planes' pixels along the side of an image pixel


@dataclass(frozen=True)
class Layers:
    """Contributions of a mesh to an image: scattering, coverage and shadow."""

    target: Float[Tensor, "rows columns"]
    """β⁰ of the lit faces in units of `Scene.unit`."""
    lit: Float[Tensor, "rows columns"]
    """Share of each pixel that lit faces cover."""
    hidden: Float[Tensor, "rows columns"]
    """Share of each pixel's flat ground (z = 0) that the target hides from the radar."""
    sections: Float[Tensor, " f"]
    """Radar cross-section of each face, m² times the unit."""

    @property
    def shadow(self) -> Float[Tensor, "rows columns"]:
        """Share of each pixel with hidden ground and without a lit face."""
        return self.hidden * (1 - self.lit)


@dataclass(frozen=True)
class MeshRenderer:
    """Renderer of closed meshes on one grid.

    `softness_m` is √σ of the coverage on all planes; the visibility of a hidden face falls by 1/e per `gamma_m` behind
    the one in front.
    """

    grid: ImageGrid
    softness_m: float
    gamma_m: float

    def layers(
        self, points: Float[Tensor, "n 3"], faces: Int64[Tensor, "f 3"], gamma0: Float[Tensor, " f"], view: View
    ) -> Layers:
        """Render a mesh with vertices `points` (finite, m, world frame) from a view.

        Faces are counter-clockwise seen from outside, and visible only from there; `gamma0` [F] is their cross-section
        per area projected along the line of sight. Differentiable in `points` and `gamma0`; each face's visible share
        is held constant.
        """
        frame = torch.as_tensor(view.look.frame, dtype=points.dtype, device=points.device)
        radar_points = points @ frame.T
        across, up, away = radar_points.unbind(1)
        normals = face_normals(radar_points, faces)
        sign = 1 if view.side == "left" else -1  # the frame of a left-looking radar is mirrored
        areas = sign * normals[:, 2] / 2  # projected along the line of sight, m²; negative if turned away
        facing = torch.nonzero(areas.detach() > 0).reshape(-1)
        with torch.no_grad():  # its gradient is mostly noise from faces smaller than pixels (baselines-dsr.md)
            visible = self._visible(radar_points, faces[facing])
        sections = picked(gamma0 * areas, facing) * visible

        lattice = self._mapping
        mapped = soft_coverage(_corners(across, away, faces[facing]), lattice, self.softness_m)
        power = picked(sections, mapped.face) * mapped.shares() / math.prod(lattice.step_m)
        target = self._responded(mapped.onto_pixels(power).reshape(lattice.rows, lattice.columns))
        cosine = picked(2 * areas / (normals.square().sum(1) + 1e-20).sqrt(), facing)
        lit = self._averaged(mapped.union(visible * (cosine / _GRAZED).clamp(max=1)))

        shadow_range = view.look.range_on_ground(across, up)  # at which the ray through a point meets the ground
        shaded = soft_coverage(_corners(across, shadow_range, faces[facing]), lattice, self.softness_m)
        hidden = self._averaged(shaded.union())
        return Layers(target, lit, hidden, torch.zeros_like(areas).index_add(0, facing, sections))

    def _visible(self, points: Float[Tensor, "n 3"], faces: Int64[Tensor, "f 3"]) -> Float[Tensor, " f"]:
        """Visible share of each face that is turned to the radar; on a closed surface, other faces hide nothing."""
        if len(faces) == 0:
            return points.new_zeros(0)
        step_m = min(width / parts for width, parts in zip(self.grid.spacing_m, self._parts, strict=True))
        lattice = Lattice.around(points[:, :2], step_m)
        plane = soft_coverage(_corners(points[:, 0], points[:, 1], faces), lattice, self.softness_m)
        level, nearest, farthest, slope = self._depths(points, faces, plane, lattice)
        covered = logsigmoid(plane.signed)
        # outside its outline, a face is extrapolated no nearer than its nearest corner where it hides others, and no
        # farther than its farthest where it is hidden: else slanted faces would hide their neighbours behind
        hiding, own = torch.maximum(level, nearest), torch.minimum(level, farthest)
        weight = grouped_softmax(covered - hiding / self.gamma_m, plane.pixel, plane.pixels + 1)
        front = picked(torch.cat([plane.onto_pixels(weight * hiding), level.new_zeros(1)]), plane.pixel)
        # opacity of the front surface; its transparency counts twice, for a closed surface has a back
        layer = torch.exp(-(hiding - front).clamp(min=0) / self.gamma_m)
        opacity = -torch.expm1(2 * plane.onto_pixels(layer * logsigmoid(-plane.signed)))
        opacity = picked(torch.cat([opacity, opacity.new_zeros(1)]), plane.pixel)
        # a sloping face may lie behind its neighbours within the softness of edges
        allowed = self.gamma_m + picked(slope, plane.face) * self.softness_m
        transmitted = 1 + opacity * torch.expm1(-(own - front - allowed).clamp(min=0) / self.gamma_m)
        within = covered.masked_fill(plane.pixel == plane.pixels, -math.inf)  # every face has a pixel on the lattice
        return plane.onto_faces(grouped_softmax(within, plane.face, plane.faces) * transmitted)

    def _depths(
        self, points: Float[Tensor, "n 3"], faces: Int64[Tensor, "f 3"], plane: Coverage, lattice: Lattice
    ) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"], Float[Tensor, " p"], Float[Tensor, " f"]]:
        """Range of each pair's face at its pixel, and of the face's nearest and farthest corner, m; slope of faces."""
        face, pixel = plane.face, plane.pixel
        a, b, c = (gathered(points, faces[:, k]) for k in range(3))
        first, second = b - a, c - a
        area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
        inverse = area / (area**2 + (_TAME * self.softness_m**2) ** 2)  # damped for faces seen edge-on
        slope_x = (first[:, 2] * second[:, 1] - second[:, 2] * first[:, 1]) * inverse
        slope_y = (second[:, 2] * first[:, 0] - first[:, 2] * second[:, 0]) * inverse
        middle = (a + b + c) / 3
        depths = torch.stack([a[:, 2], b[:, 2], c[:, 2]])
        column = (pixel % lattice.columns).to(points.dtype)
        row = torch.div(pixel, lattice.columns, rounding_mode="floor").to(points.dtype)
        across = column * lattice.step_m[0] + lattice.first_m[0] - picked(middle[:, 0], face)
        along = row * lattice.step_m[1] + lattice.first_m[1] - picked(middle[:, 1], face)
        level = picked(middle[:, 2], face) + picked(slope_x, face) * across + picked(slope_y, face) * along
        steepness = (slope_x**2 + slope_y**2 + 1e-12).sqrt()
        return level, picked(depths.amin(0), face), picked(depths.amax(0), face), steepness

    @property
    def _parts(self) -> tuple[int, int]:
        """Mapping-plane pixels per image pixel, across and along: their width is about 2·√σ."""
        across, along = (max(1, math.ceil(step / (2 * self.softness_m))) for step in self.grid.spacing_m)
        return min(across, _MOST_PARTS), min(along, _MOST_PARTS)

    @property
    def _kernels(self) -> list[list[float]]:
        """Kernels, across and along, that widen the mapping plane's soft edges to the system response."""
        kernels = []
        for step, response, parts in zip(self.grid.spacing_m, self.grid.response_variance_m2, self._parts, strict=True):
            variance = max(response - self.softness_m**2, (0.5 * step / parts) ** 2)
            if parts == 1 and variance == (0.5 * step) ** 2:
                kernels.append([1.0])
                continue
            reach = math.ceil(3 * math.sqrt(variance) / step)  # image pixels beyond this one
            offsets = [((2 * reach + 1) * parts - 1) / 2 - k for k in range((2 * reach + 1) * parts)]
            weights = [math.exp(-((offset * step / parts) ** 2) / (2 * variance)) for offset in offsets]
            kernels.append([weight / sum(weights) for weight in weights])
        return kernels

    @property
    def _margins(self) -> tuple[int, int]:
        """Margin of the mapping plane around the image, image pixels on each side."""
        across, along = (
            (len(kernel) // parts - 1) // 2 for kernel, parts in zip(self._kernels, self._parts, strict=True)
        )
        return across, along

    @property
    def _mapping(self) -> Lattice:
        """Mapping plane: the image, azimuth across and slant range along, with margins, in parts of its pixels."""
        image, parts, margins = Lattice.of(self.grid), self._parts, self._margins
        across, along = (
            (first - (margin + 0.5) * step + 0.5 * step / count, step / count, (size + 2 * margin) * count)
            for first, step, size, count, margin in zip(
                image.first_m, image.step_m, (image.columns, image.rows), parts, margins, strict=True
            )
        )
        return Lattice((across[0], along[0]), (across[1], along[1]), across[2], along[2])

    def _responded(self, power: Float[Tensor, "fine_rows fine_columns"]) -> Float[Tensor, "rows columns"]:
        """Convolve the mapping plane with the response and sample it at the image's pixels, in a fixed order."""
        across, along = self._kernels
        parts_across, parts_along = self._parts
        ends = (self.grid.rows - 1) * parts_along + 1, (self.grid.columns - 1) * parts_across + 1
        power = torch.stack([w * power[k : k + ends[0] : parts_along] for k, w in enumerate(along)]).sum(0)
        return torch.stack([w * power[:, k : k + ends[1] : parts_across] for k, w in enumerate(across)]).sum(0)

    def _averaged(self, mask: Float[Tensor, " fine"]) -> Float[Tensor, "rows columns"]:
        """Mean of the mapping plane in each pixel of the image."""
        (across, along), (left, near) = self._parts, self._margins
        rows, columns = self.grid.rows, self.grid.columns
        fine = mask.reshape(rows + 2 * near, along, columns + 2 * left, across)
        return fine[near : near + rows, :, left : left + columns].mean(dim=(1, 3))


def _corners(
    across: Float[Tensor, " n"], along: Float[Tensor, " n"], faces: Int64[Tensor, "f 3"]
) -> Float[Tensor, "f 3 2"]:
    """Corners of faces on a plane, m."""
    index = faces.reshape(-1)
    return torch.stack([picked(across, index), picked(along, index)], dim=1).reshape(-1, 3, 2)
