# %% [markdown]
# # A building in layover
#
# In a SAR image, the front of a building, its roof and the ground before it share
# pixels: they are equally far away. One image cannot take them apart. Eight passes
# that fly at slightly different heights can, because the phase between two passes
# depends on how high something is.
#
# This tutorial simulates such a stack of images and looks at its power, its phases and
# its coherence. Then it finds the heights twice: pixel by pixel with Capon's method, a
# classic of SAR tomography, and by a reconstruction from all pixels and passes at once.
# [Stacks](../concepts/stacks.md) has the conventions.

# %%
import matplotlib.pyplot as plt
import numpy as np
import trimesh
from scipy.ndimage import uniform_filter

from sarsplat import (
    Dataset,
    ImageGrid,
    ScatteringLaw,
    Stack,
    View,
    evaluate_run,
    reconstruct,
    simulate_stack,
    write_dataset,
)
from sarsplat.data import DatasetEntry
from sarsplat.evaluation.capon import capon_points

# %% [markdown]
# ## The passes
#
# The radar is at azimuth 0 and looks down at 45 degrees. What counts of a pass is its
# offset: by how large an angle its antenna is seen higher than the first (the
# perpendicular baseline over the range, b/R). The largest offset decides how fine
# heights are resolved, the smallest step at which distance they become ambiguous.

# %%
passes = 8
view = View(azimuth_deg=0.0, grazing_deg=45.0)
grid = ImageGrid(rows=44, columns=36, spacing_m=(0.5, 0.5), resolution_m=(0.6, 0.6))
stack = Stack(
    wavelength_m=0.031,
    offsets_rad=tuple(np.linspace(0.0, 0.0039, passes)),
    noise=(0.1,) * passes,
)
to_height = np.cos(np.radians(view.grazing_deg))  # of an elevation, at one range
print(f"resolution {stack.resolution_m * to_height:.1f} m of height")
print(f"ambiguous after {stack.ambiguous_elevation_m * to_height:.1f} m of height")

# %% [markdown]
# Heights can be told to better than the resolution if a pixel shows only one of them;
# two that are nearer to each other than that are hard to take apart.
#
# ## The building
#
# A box on level ground, which scatters equally in all directions. `simulate_stack`
# draws one complex image for each pass, with speckle and noise.

# %%
width, length, height = 8.0, 8.0, 10.0  # m, along x, y and z
building = trimesh.creation.box((width, length, height))
building.apply_translation((0.0, 0.0, height / 2))
signals = simulate_stack(
    building,
    view,
    grid,
    stack,
    ScatteringLaw(floor=1.0, lobe=0.0, exponent=1.0),
    ground_gamma0=1.0,
    noise=0.1,
)
signals.shape, signals.dtype

# %% [markdown]
# ## Power, phase and coherence
#
# The phase of level ground is known: `plane_phases`. Without it, the phase between two
# passes shows height. Averages over 3 × 3 pixels make it less noisy, and their
# magnitude is the coherence of the two passes.

# %%
deramped = signals * np.exp(-1j * stack.plane_phases(view, grid))


def covariance(i: int, j: int) -> np.ndarray:
    """Covariance of two passes: the mean of y_i y_j* over 3 × 3 pixels."""
    return uniform_filter(deramped[i] * deramped[j].conj(), 3)


pair = covariance(1, 0)
coherence = abs(pair) / np.sqrt(covariance(1, 1).real * covariance(0, 0).real)
decibels = 10 * np.log10(np.mean(abs(signals) ** 2, axis=0))

left, right, far, near = grid.extent_m
figure, axes = plt.subplots(1, 3, figsize=(10, 3.9), layout="constrained")
for ax, shown, title, colours, limits in (
    (axes[0], decibels, "power, dB", "gray", (-12, 8)),
    (axes[1], np.angle(pair), "phase, rad", "twilight", (-np.pi, np.pi)),
    (axes[2], coherence, "coherence", "viridis", (0, 1)),
):
    picture = ax.imshow(
        shown, cmap=colours, clim=limits, extent=(left, right, far, near)
    )
    figure.colorbar(picture, ax=ax, shrink=0.8)
    ax.set(title=title, xlabel="azimuth, m", ylabel="slant range, m")
plt.show()

# %% [markdown]
# The radar is above the images. From near to far: ground; a bright band, where front,
# roof and ground lie over each other; and the shadow, where there is only noise.
#
# On the ground, the phase is 0 and the coherence high. In the band, several heights are
# mixed in every pixel: the phase is of none of them, and the coherence low. That is
# why one pair of passes is not enough.
#
# ## Capon's method
#
# With all passes, the power of each pixel can be estimated as a function of height, and
# peaks are points. Every pixel is taken by itself.
#
# For both methods, the signals become a dataset; its folder also holds the true shape,
# which only the scores will look at.

# %%
entry = DatasetEntry(view, "train", "0", stack=stack)
dataset = Dataset.of_complex(
    grid, (entry,), signals[None], looks=1.0, ground=True, target="building"
)
dataset = write_dataset("stacks", dataset, truth_mesh=building, overwrite=True)
capon = capon_points(dataset, -2.0, height + 2.0)
f"{len(capon)} points"

# %% [markdown]
# ## Reconstruct
#
# `reconstruct` sees that the images are a stack and takes the preset `stack`. It learns
# Gaussians whose covariances between all passes explain the signals best. The result
# renders, from any direction, power (`run.render`) and covariances
# (`run.render_covariances`).

# %%
run = reconstruct(dataset, quiet=True)
f"{run.learned}, {len(run.points)} points, {run.time_s:.0f} s"

# %%
rendered = run.render_covariances([view], stack)[0]
ground = np.exp(1j * stack.plane_phases(view, grid))
learned = rendered[1, 0] * ground[1].conj() * ground[0]
shown = abs(learned) / np.sqrt(rendered[1, 1].real * rendered[0, 0].real)

figure, axes = plt.subplots(1, 4, figsize=(10, 3.3), layout="constrained")
for ax, values, title, colours, limits in (
    (axes[0], np.angle(pair), "measured phase", "twilight", (-np.pi, np.pi)),
    (axes[1], np.angle(learned), "learned phase", "twilight", (-np.pi, np.pi)),
    (axes[2], coherence, "measured coherence", "viridis", (0, 1)),
    (axes[3], shown, "learned coherence", "viridis", (0, 1)),
):
    ax.imshow(values, cmap=colours, clim=limits, extent=(left, right, far, near))
    ax.set(title=title, xlabel="azimuth, m")
axes[0].set_ylabel("slant range, m")
plt.show()

# %% [markdown]
# ## A slice through the building
#
# Along the line of sight, with the radar at the upper left: the front, the roof and the
# ground before it are separated. The space behind the building is in its shadow, where
# a few points float: there is only noise to explain.

# %%
figure, axes = plt.subplots(2, 1, figsize=(8, 6.4), sharex=True, layout="constrained")
front, back = -width / 2, width / 2
for ax, points, title in zip(axes, (capon, run.points), ("Capon", "reconstruction")):
    inside = points[abs(points[:, 1]) < 1.5]  # y: along the flight
    ax.plot(
        [-14, front, front, back, back, 16],
        [0, 0, height, height, 0, 0],
        color="0.75",
        linewidth=4,
    )
    ax.scatter(-inside[:, 0], inside[:, 2], s=4, color="C3")
    ax.set(title=title, ylabel="height, m", aspect="equal")
    ax.set(xlim=(-14, 16), ylim=(-2, height + 3))
axes[1].set_xlabel("ground range, m")
plt.show()

# %% [markdown]
# ## How good are they?
#
# `evaluate_run` scores the points where the radar has seen something, on the building
# and on the ground around it, beside Capon's. F1 combines how many points are near the
# true surface with how much of it has a point nearby.

# %%
scores = evaluate_run(run, quiet=True)
for name, whose in (("Capon", "capon"), ("reconstruction", "points")):
    found = scores[whose]["visible"]
    close = [f"{found[key]:.3f} within {key[3:]} m" for key in found if "f1@" in key]
    print(f"{name:15s} F1 {', '.join(close)}")

# %% [markdown]
# `write_report(run, "building.html")` writes a page with the phase, the coherence and a
# slice through the brightest layover. On the command line, `sarsplat simulate --passes`
# makes such stacks, and `reconstruct`, `evaluate` and `report` are the same as for any
# other images ([how](../concepts/stacks.md#reconstruction)).
