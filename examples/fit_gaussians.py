"""Fit two thousand Gaussians to simulated images of a vehicle, with nothing but torch and the renderer.

`sarsplat reconstruct` does this properly; here is the idea in forty lines.
"""

import math

import numpy as np
import torch

from sarsplat import Gaussians, Harmonics, ImageGrid, View, render
from sarsplat.scenes import ScatteringLaw, simulate_raycast, target_mesh

ITERATIONS, COUNT = 200, 2000
torch.manual_seed(0)

views = [View(azimuth, 45.0) for azimuth in range(0, 360, 45)]
grid = ImageGrid(rows=48, columns=48, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
mesh = target_mesh("t72")
power = np.stack([simulate_raycast(mesh, view, grid, ScatteringLaw()) for view in views])
truth = torch.from_numpy(power).sqrt()  # amplitude

low, high = (torch.tensor(corner, dtype=torch.float32) for corner in mesh.bounds)
means = (low + (high - low) * torch.rand(COUNT, 3)).requires_grad_()
quaternions = torch.randn(COUNT, 4).requires_grad_()
log_scales = torch.full((COUNT, 3), math.log(0.15)).requires_grad_()
log_depth = torch.full((COUNT,), math.log(0.3)).requires_grad_()
harmonics = torch.zeros(COUNT, 4).requires_grad_()

optimiser = torch.optim.Adam([means, quaternions, log_scales, log_depth, harmonics], lr=0.02)
for iteration in range(ITERATIONS):
    scene = Gaussians(means, quaternions, log_scales.exp(), log_depth.clamp(max=2.0).exp(), Harmonics(harmonics, 0.03))
    amplitude = (render(scene, views, grid).channel(0) + 1e-6).sqrt()
    loss = (amplitude - truth).abs().mean()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    if iteration % 20 == 0 or iteration == ITERATIONS - 1:
        psnr = 10 * math.log10(truth.max() ** 2 / (amplitude - truth).detach().square().mean())
        print(f"{iteration:4d}  loss {loss.item():.4f}  PSNR {psnr:.1f} dB over the training images")
