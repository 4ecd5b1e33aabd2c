"""Watch a training: a picture of one view every so often, and stop it when it is good enough."""

from dataclasses import replace
from typing import Any

from sarsplat import (
    Dataset,
    ImageGrid,
    RayGrid,
    SarImage,
    View,
    preset,
    reconstruct,
    render,
    simulate_images,
    target_mesh,
)
from sarsplat.runs import Step

grid = ImageGrid(rows=64, columns=64, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
views = [View(azimuth, 45.0) for azimuth in range(0, 360, 45)]
arrays = simulate_images(target_mesh("t72"), views, grid)
dataset = Dataset.from_images([SarImage(power, view, grid) for power, view in zip(arrays, views)])
watched = View(20.0, 45.0)  # not trained on


def watch(step: Step[Any]) -> bool:
    """Called after every step; True ends the training."""
    if step.iteration % 40 == 0:
        image = render(step.trainer.gaussians, [watched], grid, rays=RayGrid.for_image(grid, 4)).channel(0)[0].numpy()
        SarImage(image, watched, grid).save(f"step-{step.iteration:04d}.png")
        print(f"{step.iteration:4d}  loss {float(step.loss):.5f}")
        return bool(step.loss < 0.0005)
    return False


run = reconstruct(dataset, replace(preset("default"), iterations=240, gaussians=3000), on_step=watch, quiet=True)
print(f"{run.iteration} of {run.config.iterations} steps, {len(run.points)} points")
