# %% [markdown]
# # Your own data from arrays
#
# You have SAR images as arrays, from any sensor or program. Three things have to be
# right before a reconstruction means anything: the quantity, how the array lies, and
# where the radar was. This notebook checks each.

# %%
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from sarsplat import (
    Dataset,
    ImageGrid,
    SarImage,
    View,
    preset,
    reconstruct,
    simulate_images,
    target_mesh,
)

# %% [markdown]
# ## Recorded arrays
#
# In place of your files: amplitudes of a vehicle, near range in the *last* row,
# incidence angles instead of grazing angles, and headings of the aircraft instead of
# azimuths.

# %%
grid = ImageGrid(
    rows=64, columns=64, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3)
)  # (azimuth, range)
headings_deg = [0, 60, 120, 180, 240, 300] * 2
incidences_deg = [60.0] * 6 + [30.0] * 6


def to_view(heading_deg: float, incidence_deg: float) -> View:
    """View of a right-looking radar, which is to the left of its scene."""
    return View(azimuth_deg=(heading_deg - 90) % 360, grazing_deg=90 - incidence_deg)


views = [
    to_view(heading, incidence)
    for heading, incidence in zip(headings_deg, incidences_deg)
]
recorded = [
    np.sqrt(power)[::-1, ::-1]
    for power in simulate_images(target_mesh("btr70"), views, grid)
]
recorded[0].shape, recorded[0].max()

# %% [markdown]
# ## Quantity and orientation
#
# Power is the square of amplitude. Near range was the last row, so the array is turned
# by half a turn, which keeps it a true map; flipping only the rows would mirror the
# target.

# %%
images = [
    SarImage(np.rot90(amplitude, 2) ** 2, view, grid)
    for amplitude, view in zip(recorded, views)
]
images[0]

# %% [markdown]
# ## Are the views right?
#
# A wrong azimuth convention is the commonest mistake, and it does not announce itself:
# the training goes through, and the target is a blur. A quick test needs no truth: hold
# one view out. If it is predicted well, the geometry is consistent; compare with
# azimuths that run the wrong way round.


# %%
def held_out_error_db(views: list[View]) -> float:
    """Amplitude error of the last view after learning from the others, dB."""
    named = [SarImage(image.power, view, grid) for image, view in zip(images, views)]
    quick = replace(preset("quick"), iterations=100, gaussians=2000)
    run = reconstruct(Dataset.from_images(named[:-1]), quick, quiet=True)
    difference = np.sqrt(run.render(views[-1:])[0]) - np.sqrt(named[-1].power)
    return 10 * np.log10(np.mean(difference**2) / named[-1].power.max())


mirrored = [View(-view.azimuth_deg % 360, view.grazing_deg) for view in views]
print(f"as labelled {held_out_error_db(views):.1f} dB")
print(f"the wrong way round {held_out_error_db(mirrored):.1f} dB")

# %% [markdown]
# Mean square below the brightest pixel, so lower is better: as labelled it is.
# (A target that looks the same from left and right
# would hide the mistake.)
#
# ## Reconstruct, look, keep

# %%
dataset = Dataset.from_images(images, target="my vehicle")
run = reconstruct(dataset, "quick", out="my-run", overwrite=True, quiet=True)
f"{len(run.points)} points; heights up to {np.ptp(run.points[:, 2]):.1f} m"

# %%
unseen = View(15.0, 45.0)
SarImage(run.render([unseen])[0], unseen, run.grid)

# %%
some = np.random.default_rng(0).permutation(run.points)[:15_000]
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
for ax, up in zip(axes, (2, 1)):
    some = some[np.argsort(some[:, 3 - up] * (1 if up == 1 else -1))]
    ax.scatter(some[:, 0], some[:, up], c=some[:, 2], s=0.6, cmap="viridis")
    ax.set(aspect="equal", xlabel="x, m", ylabel="yz"[up - 1] + ", m")
plt.show()

# %% [markdown]
# The run is in the folder `my-run`: `sarsplat report my-run` writes its page, `sarsplat
# export my-run vehicle.glb` a mesh. Images with speckle or ground need two more words,
# `looks=1` and `ground=True` ([how](../how-to/ground-and-speckle.md)).
