"""Render a map and follow the image gradient: recover colours and the camera position."""

import torch

from splatbot import rasterization

generator = torch.Generator().manual_seed(0)
means = torch.rand(200, 3, generator=generator) - 0.5 + torch.tensor([0.0, 0.0, 2.0])
quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(200, 1)
scales = torch.full((200, 3), 0.05)
opacities = torch.full((200,), 0.8)
true_colors = torch.rand(200, 3, generator=generator)
K = torch.tensor([[[80.0, 0.0, 40.0], [0.0, 80.0, 30.0], [0.0, 0.0, 1.0]]])


def render(colors: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """Return the image (60, 80, 3) of a camera that is shifted by ``translation`` (3,) [m]."""
    viewmat = torch.eye(4)[None].clone()
    viewmat[0, :3, 3] = translation
    image, _, _ = rasterization(means, quats, scales, opacities, colors, viewmat, K, 80, 60)
    return image[0]


target = render(true_colors, torch.zeros(3))
colors = torch.full((200, 3), 0.5, requires_grad=True)
translation = torch.tensor([0.02, -0.01, 0.0], requires_grad=True)
optimizer = torch.optim.Adam([{"params": [colors], "lr": 0.05}, {"params": [translation], "lr": 0.001}])
for step in range(101):
    optimizer.zero_grad()
    loss = torch.mean((render(colors, translation) - target) ** 2)
    loss.backward()
    if step % 50 == 0:
        offset = 1e3 * translation.detach().norm()
        print(f"step {step}: loss {loss.item():.6f}, camera error {offset.item():.1f} mm")
    optimizer.step()
