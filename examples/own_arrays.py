"""Your own data: images in arrays, nothing on the disk, a point cloud out.

The arrays here are simulated; put yours in their place: linear power, row 0 near range, columns along the flight.
"""

from dataclasses import replace

import numpy as np

from sarsplat import Dataset, ImageGrid, SarImage, View, preset, reconstruct, simulate_images, target_mesh

grid = ImageGrid(rows=64, columns=64, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
views = [View(azimuth, grazing) for grazing in (30.0, 60.0) for azimuth in range(0, 360, 60)]
arrays = simulate_images(target_mesh("btr70"), views, grid)

images = [SarImage(power, view, grid) for power, view in zip(arrays, views)]
images[0].save("first-image.png")  # decibels, axes in metres; in a notebook, `images[0]` alone shows it
dataset = Dataset.from_images(images, target="my vehicle")

run = reconstruct(dataset, replace(preset("default"), iterations=150, gaussians=3000))  # out="run" keeps it on the disk
print(f"{run.learned}, {len(run.points)} points; heights up to {np.ptp(run.points[:, 2]):.1f} m")
unseen = SarImage(run.render([View(15.0, 45.0)])[0], View(15.0, 45.0), run.grid)
unseen.save("unseen-view.png")
