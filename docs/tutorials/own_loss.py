# %% [markdown]
# # Your own loss
#
# A reconstruction minimises a loss between rendered and true images. You can give your
# own: any function of two stacks of β⁰ that torch can differentiate. Here, one that
# compares decibels instead of amplitudes, so that faint parts count as much as bright
# ones.

# %%
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import torch

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

grid = ImageGrid(rows=64, columns=64, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
views = [View(azimuth, 45.0) for azimuth in range(0, 360, 45)]
arrays = simulate_images(target_mesh("t72"), views, grid)
dataset = Dataset.from_images(
    [SarImage(power, view, grid) for power, view in zip(arrays, views)]
)

# %% [markdown]
# ## The loss
#
# Decibels of nothing are minus infinity, so there is a lowest level that counts. What
# is darker counts as equally dark.

# %%
DARKEST = 1e-3  # β⁰, linear power


def decibels(rendered: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Mean absolute difference, dB, of two stacks [views, rows, columns] of β⁰."""
    return (
        10
        * (torch.log10(rendered + DARKEST) - torch.log10(truth + DARKEST)).abs().mean()
    )


# %% [markdown]
# ## Train twice
#
# Once with the preset's own loss, once with ours; `on_step` is called after every step
# and collects the curve.

# %%
settings = replace(preset("default"), iterations=150, gaussians=3000)


def trained(loss):
    curve = []

    def watch(step):
        curve.append(float(step.loss))

    return reconstruct(dataset, settings, loss=loss, quiet=True, on_step=watch), curve


runs, curves = {}, {}
for name, loss in (("the preset's", None), ("decibels", decibels)):
    runs[name], curves[name] = trained(loss)

figure, ax = plt.subplots(figsize=(6, 2.8), layout="constrained")
for name, curve in curves.items():
    ax.semilogy(np.array(curve) / curve[0], label=name)
ax.set(xlabel="iteration", ylabel="loss / first loss")
ax.legend()
plt.show()

# %% [markdown]
# ## Effect
#
# Each loss is best at its own criterion. Judged in decibels:

# %%
truth = torch.as_tensor(dataset.power)
for name, run in runs.items():
    off = decibels(torch.as_tensor(run.render(views)), truth)
    print(f"trained on {name:13s} {off:.3f} dB off")

# %%
unseen = View(20.0, 45.0)
pictures = [
    simulate_images(target_mesh("t72"), [unseen], grid)[0],
    *(run.render([unseen])[0] for run in runs.values()),
]
figure, axes = plt.subplots(1, 3, figsize=(9, 3.3), layout="constrained")
for ax, power, title in zip(
    axes, pictures, ("truth, unseen view", "the preset's loss", "decibels")
):
    ax.imshow(10 * np.log10(power / arrays.max() + 1e-6), cmap="gray", vmin=-40, vmax=0)
    ax.set(xticks=[], yticks=[], title=title)
plt.show()

# %% [markdown]
# To make a loss available as `--loss NAME` on the command line, see
# [Contributing](../../CONTRIBUTING.md). Likelihoods of speckle are there already:
# `preset("speckled")`.
