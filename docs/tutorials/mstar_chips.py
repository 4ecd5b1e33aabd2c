# %% [markdown]
# # Measured chips (MSTAR)
#
# From a folder of chips to a target, with a fair answer to the question whether it is
# any good. The public MSTAR chips are not part of sarsplat, so this notebook simulates
# chips in the same form: JPEGs of single-look magnitude with near range at the bottom,
# and a table of labels. To use real ones, set the environment variable `MSTAR_CHIPS` to
# their folder, with `labels.csv` in it ([its
# columns](../reference/formats/mstar.md#the-table-of-labels)), and run the notebook
# again.

# %%
import csv
import os
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from sarsplat import (
    View,
    add_speckle,
    evaluate_run,
    import_mstar,
    mstar_grid,
    preset,
    reconstruct,
    simulate_images,
    target_mesh,
)

# %% [markdown]
# ## Chips
#
# A T-72-like target on grass, seen from 36 directions at a grazing angle of 17°. The
# magnitude is the root of power. An angle called TargetAz labels each chip; it runs the
# other way round than sarsplat's azimuth
# ([conventions](../reference/formats/mstar.md#6-measured-chips-mstar)).


# %%
def make_chips(folder: Path) -> None:
    """Simulated chips, and their table."""
    azimuths = [10.0 * k for k in range(36)]
    views = [View(-azimuth % 360, 17.0) for azimuth in azimuths]
    power = simulate_images(
        target_mesh("t72"), views, mstar_grid(), ground_gamma0=0.04, ray_spacing=0.08
    )
    power = add_speckle(power, 1, np.random.default_rng(0))
    folder.mkdir(exist_ok=True)
    with (folder / "labels.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(
            [
                "path",
                "class",
                "serial",
                "desired_depression_deg",
                "measured_depression_deg",
                "target_az_deg",
            ]
        )
        for azimuth, image in zip(azimuths, power):
            name = f"{azimuth:03.0f}.jpeg"
            magnitude = np.rot90(
                np.sqrt(image / np.quantile(power, 0.999)), 2
            )  # near range at the bottom
            Image.fromarray((255 * magnitude).clip(0, 255).astype(np.uint8)).save(
                folder / name, quality=95
            )
            table.writerow([name, "T72", "simulated", 17, 17.0, azimuth])


chips = Path(os.environ.get("MSTAR_CHIPS", "chips"))
if not chips.exists():
    make_chips(chips)
len(list(chips.rglob("*.jpeg")))

# %% [markdown]
# ## Import
#
# The chips nearest to twelve evenly spaced azimuths are trained on; all others are test
# images, named by their depression.

# %%
dataset = import_mstar(
    chips,
    "chips-dataset",
    labels=chips / "labels.csv",
    target_class="T72",
    train_views=12,
    overwrite=True,
)
{name: len(dataset.select(name)) for name in dataset.splits()}

# %% [markdown]
# Look at one before anything else: near range is at the top now, and the shadow must
# fall downwards. If it does not, the chips lie differently, and everything after this
# would be nonsense.

# %%
dataset[0]

# %% [markdown]
# ## Reconstruct
#
# The preset `measured` models speckle, ground, side lobes, shifts and gains of the
# chips ([term by term](../concepts/measured-chips.md)). It takes 800 iterations; 200
# are enough to see how it goes.

# %%
run = reconstruct(dataset, replace(preset("measured"), iterations=200), quiet=True)
f"{run.learned}, {len(run.points)} points, {run.time_s:.0f} s"

# %%
test = dataset.splits()[-1]
views = dataset.select(test).views[:3]
figure, axes = plt.subplots(2, 3, figsize=(8, 5.6), layout="constrained")
for row, images in zip(axes, (dataset.images(test)[:3], run.render(views))):
    for ax, image, view in zip(row, images, views):
        ax.imshow(
            10 * np.log10(image / run.brightest + 1e-6), cmap="gray", vmin=-40, vmax=0
        )
        ax.set(xticks=[], yticks=[], title=f"azimuth {view.azimuth_deg:.0f}°")
axes[0, 0].set_ylabel("measured")
axes[1, 0].set_ylabel("predicted")
plt.show()

# %% [markdown]
# The prediction has no speckle: it is the mean that the speckle varies around.
#
# ## Is it any good?
#
# Compare it with predictions that know nothing of a third dimension. *Rotated average*:
# the training chips turned to the requested azimuth, averaged. *Nearest chip*: the one
# with the nearest azimuth, smoothed. Nats per pixel are lower, and the correlation
# higher, for better predictions; both leave out where a chip lies in its frame and how
# bright it is.

# %%
scores = evaluate_run(run, quiet=True)
found = {"sarsplat": scores["images"][test], **scores["baselines"][test]}
for name, score in found.items():
    nats, correlation = (
        score["registered_nats_per_pixel"],
        score["registered_log_correlation"],
    )
    print(f"{name:20s} {nats:7.3f} nats per pixel   correlation {correlation:.3f}")

# %% [markdown]
# More chips, more iterations (the default of `preset("measured")`) and several
# depressions (`train_depression=[15, 17, 30]`) help. Results on the real chips are in
# [Measured chips, term by term](../concepts/measured-chips.md) and in the
# [README](../../README.md#measured-images). On the command line the same is `sarsplat
# import mstar`, `sarsplat reconstruct`, `sarsplat evaluate`.
