# %% [markdown]
# # A satellite by inverse SAR
#
# A radar that stands still, and a satellite that turns: each frame is an image of the
# plane that its line of sight and its motion span. Here are 24 frames about three axes,
# their reconstruction and its errors, also if the assumed rotation is slightly wrong.

# %%
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from sarsplat import (
    Dataset,
    ImageGrid,
    SarImage,
    Turn,
    point_metrics,
    preset,
    reconstruct,
    simulate_images,
    target_mesh,
    visible_surface,
)
from sarsplat.evaluation import Yardstick

# %% [markdown]
# ## Frames
#
# A `Turn` says about which axis the target has turned, and by how much since the
# attitude was known; with the line of sight at that time, all in the target's frame,
# that makes the view of a frame. Eight frames about each axis to learn from, and one
# between two of them to judge by.

# %%
mesh = target_mesh("satellite")
grid = ImageGrid(rows=52, columns=52, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
sight = (1.0, 0.4, 0.6)
axes = {"z": (0.0, 0.0, 1.0), "x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0)}

turns = [
    Turn(axis, 45.0 * k, name=name) for name, axis in axes.items() for k in range(8)
]
between = [Turn(axis, 67.5, name=name) for name, axis in axes.items()]
views = [turn.seen_from(sight) for turn in turns]
unseen_views = [turn.seen_from(sight) for turn in between]
frames = simulate_images(mesh, views, grid)
unseen = simulate_images(mesh, unseen_views, grid)
views[9]

# %% [markdown]
# Yours are arrays, too: β⁰ in linear power, near range in row 0, columns growing with
# Doppler frequency, and cross-range scaled to metres as
# [Image what flies](../how-to/isar.md) says.

# %%
brightest = frames.max()


def show(ax, power, title):
    """An image in decibels below the brightest pixel of all frames."""
    level = 10 * np.log10(power / brightest + 1e-6)
    ax.imshow(level, cmap="gray", vmin=-40, vmax=0)
    ax.set(xticks=[], yticks=[], title=title)


figure, panels = plt.subplots(3, 6, figsize=(9, 4.9), layout="constrained")
for row, name in enumerate(axes):
    for column in range(6):
        turn = turns[8 * row + column]
        title = f"{name}, {turn.angle_deg:.0f}°"
        show(panels[row, column], frames[8 * row + column], title)
plt.show()

# %% [markdown]
# Wings are lines where the image plane holds their normal, and panels where it is
# their own. No frame shows height, and there is no shadow to guess it from: it takes
# many planes.
#
# ## Reconstruct


# %%
def dataset_of(images, some_turns, some_unseen):
    """A dataset of frames with assumed rotations."""
    learned, others = (
        [
            SarImage(power, turn.seen_from(sight), grid)
            for power, turn in zip(powers, known)
        ]
        for powers, known in ((images, some_turns), (unseen, some_unseen))
    )
    return Dataset.from_images(
        learned, test=others, turns=[*some_turns, *some_unseen], target="satellite"
    )


dataset = dataset_of(frames, turns, between)
quick = replace(preset("quick"), iterations=300)
run = reconstruct(dataset, quick, quiet=True)
f"{run.learned}, {len(run.points)} points"

# %%
figure, panels = plt.subplots(2, 3, figsize=(6, 4.4), layout="constrained")
predicted = run.render(unseen_views)
for column, name in enumerate(axes):
    show(panels[0, column], unseen[column], f"{name}, 68°")
    show(panels[1, column], predicted[column], "")
panels[0, 0].set_ylabel("true")
panels[1, 0].set_ylabel("predicted")
plt.show()

# %% [markdown]
# ## How far off are the points?
#
# They are compared with the surface that some frame shows; half a resolution cell is
# 0.15 m.

# %%
yardstick = Yardstick.of(grid)
truth = visible_surface(mesh, views, yardstick.ray_spacing_m, samples=50_000)


def chamfer_m(points):
    """The mean of both mean distances between points and the surface, m."""
    return point_metrics(points, truth.triangles, truth.samples, yardstick).cd_m


f"Chamfer distance {chamfer_m(run.points):.3f} m"


# %%
def draw(ax, points, title):
    """Points from the side and a little from above, coloured by height."""
    some = np.random.default_rng(0).permutation(points)[:15_000]
    some = some[np.argsort(-some[:, 0])]
    across, up = some[:, 1] + 0.4 * some[:, 0], some[:, 2] + 0.3 * some[:, 0]
    ax.scatter(across, up, c=some[:, 2], s=0.5, cmap="viridis")
    ax.set(aspect="equal", xticks=[], yticks=[], title=title)


figure, panels = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
draw(panels[0], truth.samples, "what frames show")
draw(panels[1], run.points, "reconstructed")
plt.show()

# %% [markdown]
# ## A rotation that is not quite known
#
# The rate of rotation follows from a track or a light curve, and is wrong by per cent:
# angles are then wrong by as much, and so is the scale of cross-range. Here the
# satellite turned faster by 3 % than was assumed about the first axis, and slower about
# the others. The recorded Doppler frequencies are the same; scaled by the assumed rate,
# pixels appear a little narrower.

# %%
faster = {"z": 0.03, "x": -0.03, "y": -0.03}
of_passes = []
for name in axes:
    rate = 1 + faster[name]
    true_pixels = replace(
        grid, spacing_m=(0.3 / rate, 0.3), resolution_m=(0.3 / rate, 0.3)
    )
    of_pass = [view for view, turn in zip(views, turns) if turn.name == name]
    of_passes.append(simulate_images(mesh, of_pass, true_pixels) / rate)
recorded = np.concatenate(of_passes)


def assumed(turn, rate_std):
    """The turn at the rate that was assumed, and how well that is known."""
    angle_deg = turn.angle_deg / (1 + faster[turn.name])
    return replace(turn, angle_deg=angle_deg, rate_std=rate_std)


results = {}
for title, rate_std in (("taken as exact", 0.0), ("refined", 0.03)):
    wrong = [assumed(turn, rate_std) for turn in turns]
    wrong_between = [assumed(turn, rate_std) for turn in between]
    results[title] = reconstruct(
        dataset_of(recorded, wrong, wrong_between), quick, quiet=True
    )
    print(f"{title}: Chamfer distance {chamfer_m(results[title].points):.3f} m")
results["refined"].about["corrected rotations"]

# %%
figure, panels = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
for ax, (title, one) in zip(panels, results.items()):
    draw(ax, one.points, title)
plt.show()

# %% [markdown]
# An axis that is known to within degrees has `axis_std_deg`. What the frames cannot
# say stays as it was assumed: a rotation of everything, and what one pass alone leaves
# open ([Image what flies](../how-to/isar.md#rotations-that-are-not-quite-known)).
