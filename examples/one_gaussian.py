"""One Gaussian, one view, one grid: an image, a cross-section, and the gradient of a loss."""

import torch

from sarsplat import Gaussians, Harmonics, ImageGrid, View, render

gaussian = Gaussians(
    means=torch.tensor([[0.0, 0.0, 1.0]], requires_grad=True),  # m
    quaternions=torch.tensor([[0.9, 0.1, 0.3, 0.0]], requires_grad=True),  # w, x, y, z
    scales=torch.tensor([[0.8, 0.4, 0.2]], requires_grad=True),  # m
    optical_depth=torch.tensor([1.5], requires_grad=True),  # two-way, through the centre
    scattering=Harmonics(torch.tensor([[1.0, 0.3, 0.0, -0.2]], requires_grad=True)),  # γ⁰, degree 1
)
view = View(azimuth_deg=30.0, grazing_deg=40.0)
grid = ImageGrid(rows=64, columns=64, spacing_m=(0.2, 0.2), resolution_m=(0.3, 0.3))  # m

rendering = render(gaussian, [view], grid)
image = rendering.channel(0)[0]  # β⁰, linear power; row 0 is near range
print(f"cross-section {rendering.cross_sections[0, 0, 0]:.3f} m², image sum {image.sum() * 0.2 * 0.2:.3f} m²")

target = image.detach().roll(3, dims=0)  # the same, three pixels farther away
(image - target).square().mean().backward()
for name, tensor in gaussian.tensors().items():
    print(f"{name}: {tensor.grad}")
