# %% [markdown]
# # Your own mesh
#
# You have a 3D model, and want to know how it looks to a radar, and how well it could
# be reconstructed from radar images. Any triangle mesh will do: metres, nose towards
# +x, left towards +y, standing on z = 0. Here it is a small boat, made of two boxes and
# a mast.

# %%
import matplotlib.pyplot as plt
import numpy as np
import trimesh

from sarsplat import (
    Dataset,
    ImageGrid,
    SarImage,
    View,
    point_metrics,
    reconstruct,
    simulate_images,
    visible_surface,
)
from sarsplat.evaluation import Yardstick

hull = trimesh.creation.box(extents=(8.0, 2.6, 1.2))
hull.apply_translation((0, 0, 0.6))
cabin = trimesh.creation.box(extents=(2.4, 1.8, 1.4))
cabin.apply_translation((-1.2, 0, 1.9))
mast = trimesh.creation.cylinder(radius=0.12, height=2.4)
mast.apply_translation((-1.2, 0, 3.8))
mesh = hull + cabin + mast  # yours: trimesh.load_mesh("boat.obj")
mesh.bounds

# %% [markdown]
# ## Images
#
# The grid says where the pixels lie; its resolution should be a few times smaller than
# the details you care for. Eight azimuths at two grazing angles to learn from, and four
# directions in between to judge by.

# %%
grid = ImageGrid(rows=72, columns=72, spacing_m=(0.25, 0.25), resolution_m=(0.3, 0.3))
train = [
    View(azimuth, grazing) for grazing in (25.0, 55.0) for azimuth in range(0, 360, 45)
]
test = [View(azimuth, 40.0) for azimuth in (20.0, 110.0, 200.0, 290.0)]
images = [
    SarImage(power, view, grid)
    for view, power in zip(train, simulate_images(mesh, train, grid))
]
unseen = [
    SarImage(power, view, grid)
    for view, power in zip(test, simulate_images(mesh, test, grid))
]
images[1]

# %% [markdown]
# Cabin and mast lean towards the radar: their tops are nearer than their feet
# ([layover](../learn/primer.md#2-layover)).
#
# ## Reconstruct

# %%
dataset = Dataset.from_images(images, test=unseen, target="boat")
run = reconstruct(dataset, "quick", quiet=True)
f"{run.learned}, {len(run.points)} points, {run.time_s:.0f} s"

# %%
figure, axes = plt.subplots(2, 4, figsize=(9, 4.8), layout="constrained")
for row, pictures in zip(
    axes, ([image.power for image in unseen], list(run.render(test)))
):
    for ax, power, view in zip(row, pictures, test):
        ax.imshow(
            10 * np.log10(power / run.brightest + 1e-6), cmap="gray", vmin=-40, vmax=0
        )
        ax.set(xticks=[], yticks=[], title=f"azimuth {view.azimuth_deg:.0f}°")
axes[0, 0].set_ylabel("true")
axes[1, 0].set_ylabel("predicted")
plt.show()

# %% [markdown]
# ## How far off are the points?
#
# Only the surface that the radar has seen can be found, so that is what the points are
# held against.

# %%
yardstick = Yardstick.of(grid)
truth = visible_surface(mesh, train, yardstick.ray_spacing_m)
scores = point_metrics(run.points, truth.triangles, truth.samples, yardstick)
print(f"accuracy {scores.accuracy_m:.3f} m, completeness {scores.completeness_m:.3f} m")

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
for ax, points, title in zip(
    axes, (truth.samples, run.points), ("what the radar has seen", "reconstructed")
):
    some = np.random.default_rng(0).permutation(points)[:20_000]
    some = some[np.argsort(-some[:, 1])]
    ax.scatter(
        some[:, 0] + 0.35 * some[:, 1],
        some[:, 2] + 0.25 * some[:, 1],
        c=some[:, 2],
        s=0.6,
        cmap="viridis",
    )
    ax.set(aspect="equal", xticks=[], yticks=[], title=title)
plt.show()

# %% [markdown]
# `run.mesh()` is a surface through the points, and `run.mesh().export("boat.ply")`
# writes it. To simulate ground, speckle or other scattering laws, see
# `help(sarsplat.simulate_images)`; on the command line all of this is `sarsplat
# simulate --mesh boat.obj …` and [further commands](../reference/command-line.md).
