# %% [markdown]
# # Recognise with twelve chips a class
#
# Twelve chips of each of three vehicles, with speckle and on grass: which vehicle does
# another chip show, and how does it stand? Each class is reconstructed once, and every
# chip is compared with the reconstructions, rendered from all around. No network is
# trained. The chips are simulated, so that this runs anywhere; with MSTAR's it is the
# same ([how-to](../how-to/recognise.md)).

# %%
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from sarsplat import (
    Dataset,
    ImageGrid,
    SarImage,
    View,
    add_speckle,
    locate,
    preset,
    reconstruct,
    simulate_images,
    target_mesh,
)

# %% [markdown]
# ## Chips
#
# Learned from at a grazing angle of 17°, every 30°. To be recognised at 15°, from
# anywhere; their azimuths and classes serve as labels only. A third set, at 17°, tells
# how far the odds can be trusted.

# %%
grid = ImageGrid(rows=64, columns=64, spacing_m=(0.25, 0.25), resolution_m=(0.3, 0.3))
rng = np.random.default_rng(0)


def chips(name: str, views: list[View], seed: int) -> list[SarImage]:
    """Single-look chips of a built-in vehicle on grass."""
    mesh = target_mesh(name)
    power = simulate_images(mesh, views, grid, ground_gamma0=0.05)
    power = add_speckle(power, 1, np.random.default_rng(seed))
    return [SarImage(one, view, grid) for one, view in zip(power, views)]


def anywhere(count: int, grazing: float) -> list[View]:
    """Views from random azimuths."""
    return [View(azimuth, grazing) for azimuth in rng.uniform(0, 360, count)]


datasets = []
for seed, name in enumerate(("t72", "btr70", "2s1")):
    train = chips(name, [View(30.0 * k, 17.0) for k in range(12)], seed)
    test = chips(name, anywhere(20, 15.0), 10 + seed)
    datasets.append(
        Dataset.from_images(train, test=test, target=name, looks=1.0, ground=True)
    )
known = [
    Dataset.from_images(
        chips(one.target, anywhere(8, 17.0), 20 + seed),
        target=one.target,
        looks=1.0,
        ground=True,
    )
    for seed, one in enumerate(datasets)
]
[len(dataset) for dataset in datasets]

# %% [markdown]
# ## A reconstruction of each class
#
# The preset `measured`, cut short: for real chips leave it as it is.

# %%
quick = replace(preset("measured"), iterations=150)
runs = [reconstruct(dataset, quick, quiet=True) for dataset in datasets]
[f"{run.target}: {run.time_s:.0f} s" for run in runs]

# %% [markdown]
# ## Class, azimuth and odds

# %%
found = locate(runs, datasets, calibrate=known, step_deg=4)
found.scores_in_words()

# %%
for row in found.rows()[::12]:
    print(
        f"{row['labelled_class']:6} at {float(row['labelled_azimuth_deg']):5.1f}°: "
        f"{row['class']:6} ({float(row['odds']):.0%}) at "
        f"{float(row['azimuth_deg']):5.1f}° ± {float(row['azimuth_std_deg']):.1f}°"
    )

# %% [markdown]
# Rows of the table are labelled classes, columns those found:

# %%
print(found.classes)
found.confusion

# %% [markdown]
# ## What explains a chip
#
# Beside three chips, the rendering of the class and azimuth that were found.

# %%
figure, axes = plt.subplots(2, 3, figsize=(9, 6.2), layout="constrained")
for (above, below), index in zip(axes.T, (0, 20, 40)):
    best = found.found[index]
    chip, run = found.chips[index], found.runs[found.run_index[index, best]]
    view = replace(chip.view, azimuth_deg=float(found.azimuth_deg[index, best]))
    for ax, power, title in (
        (above, chip.power, f"{chip.target}, {chip.azimuth_deg:.0f}°"),
        (below, run.render([view])[0], f"{run.target}, {view.azimuth_deg:.0f}°"),
    ):
        ax.imshow(
            10 * np.log10(power / power.max() + 1e-6), cmap="gray", vmin=-40, vmax=0
        )
        ax.set(xticks=[], yticks=[], title=title)
plt.show()

# %% [markdown]
# The simulated grass is the same everywhere. Measured chips of one campaign also share
# the field, from which class and azimuth can partly be read: compare with
# `ground="flat"`. A vehicle that is none of the three is still called one of them.
#
# On the command line: `sarsplat locate RUN … IMAGES --calibrate LABELLED --out
# found.csv`, with a page that shows chips, confusions and reliability.
