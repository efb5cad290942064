"""Small random scenes for the tests of the rasterizer, and their comparison with the float64 reference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from splatbot.rasterize import Gaussians, Viewpoints, rasterization, rasterization_reference
from splatbot.rasterize.native import native
from splatbot.rasterize.reference import Projector

FORWARD_BOUND = 1e-5
"""Largest absolute difference of colours, depth and alpha from the float64 reference."""
GRADIENT_BOUND = 1e-4
"""Largest relative L2 difference [1] of gradients from the float64 reference."""
NAMES = ("means", "quats", "scales", "covars", "opacities", "colors", "viewmats", "Ks", "backgrounds")


def two_roundings(bound: float) -> float:
    """Return an error bound for the kernels in use: SSE4.2 has no fused multiply-add and loses more in differences."""
    return 8.0 * bound if native().isa() == "v2" else bound


@dataclass
class Scene:
    """Float32 inputs of a render of C views; ``backgrounds``, and quats and scales or covars, may be None."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    backgrounds: Tensor | None = None
    covars: Tensor | None = None

    def gaussians(self, sh_degree: int | None = None) -> Gaussians:
        """Return the arguments of a render that do not change from view to view."""
        return Gaussians(self.means, self.quats, self.scales, self.opacities, self.colors, self.covars, sh_degree)

    @property
    def viewpoints(self) -> Viewpoints:
        """Poses, intrinsics and backgrounds of the views."""
        return Viewpoints(self.viewmats, self.Ks, self.width, self.height, self.backgrounds)

    def render(self, render_mode: str = "RGB", **options: Any) -> tuple[Tensor, Tensor, Any]:
        """Render through the native kernels."""
        return rasterization(**vars(self), render_mode=render_mode, **options)

    def reference(self, render_mode: str = "RGB", **options: Any) -> tuple[Tensor, Tensor, Any]:
        """Render through the float64 reference."""
        return self.to(torch.float64).reference_leaves(render_mode, **options)

    def reference_leaves(
        self, render_mode: str = "RGB", *, sh_degree: int | None = None, **options: Any
    ) -> tuple[Tensor, Tensor, Any]:
        """Render through the reference with these tensors, so that gradients reach them."""
        return rasterization_reference(self.gaussians(sh_degree), self.viewpoints, render_mode=render_mode, **options)

    def alone(self, i: int) -> Scene:
        """Return Gaussian i alone, before a black background."""
        rows = {n: getattr(self, n)[i : i + 1] for n in ("means", "quats", "scales", "opacities", "colors")}
        return Scene(**rows, viewmats=self.viewmats, Ks=self.Ks, width=self.width, height=self.height)

    def to(self, dtype: torch.dtype, requires_grad: bool = False) -> Scene:
        """Return a copy whose tensors are leaves of ``dtype``."""
        tensors = {
            name: None if value is None else value.detach().to(dtype).clone().requires_grad_(requires_grad)
            for name in NAMES
            for value in [getattr(self, name)]
        }
        return Scene(**tensors, width=self.width, height=self.height)  # type: ignore[arg-type]


@dataclass
class Comparison:
    """Native against reference, over the pixels that rounding cannot throw over one of the model's jumps."""

    forward: float  # largest absolute difference of colours, depth and alpha
    gradients: dict[str, float]  # relative L2 by input
    near_jumps: int  # pixels left out
    pixels: int


def compare(
    scene: Scene,
    render_mode: str,
    *,
    jump_margin: float = 2e-5,
    project: Projector | None = None,
    reference_extra: dict[str, Any] | None = None,
    fixed: tuple[str, ...] = (),
    **options: Any,
) -> Comparison:
    """Compare forward pass and gradients of a random loss in the kernels and in float64, from the same float32 inputs.

    A pixel nearer than ``jump_margin`` (relative) to a jump of the model has no weight in either. Jumps are an alpha at
    1/255 or at its cap, and a transmittance at 1e-4. The caller bounds the number of such pixels. ``project`` is the
    reference's camera, which takes ``reference_extra``; the options then apply to the kernels alone. Inputs named in
    ``fixed`` require no gradient.
    """
    reference_options = options if project is None else {"project": project, **(reference_extra or {})}
    sides = []
    for dtype in (torch.float64, torch.float32):
        leaves = scene.to(dtype, requires_grad=True)
        for name in fixed:
            getattr(leaves, name).requires_grad_(False)
        if dtype == torch.float64:
            image, alpha, meta = leaves.reference_leaves(render_mode, **reference_options)
        else:
            image, alpha, meta = leaves.render(render_mode, **options)
        sides.append((leaves, image, alpha, meta))
    (exact, exact_image, exact_alpha, meta), (native, image, alpha, _) = sides
    safe = (meta.margins > jump_margin)[..., None]
    differences = [(exact_image - image.double()).abs() * safe, (exact_alpha - alpha.double()).abs() * safe]
    generator = torch.Generator().manual_seed(1)
    weights = torch.randn(exact_image.shape, generator=generator, dtype=torch.float64).float() * safe
    alpha_weights = torch.randn(exact_alpha.shape, generator=generator, dtype=torch.float64).float() * safe
    ((exact_image * weights.double()).sum() + (exact_alpha * alpha_weights.double()).sum()).backward()
    ((image * weights).sum() + (alpha * alpha_weights).sum()).backward()
    gradients = {}
    for name in NAMES:
        want, got = (getattr(side, name) for side in (exact, native))
        if want is not None and want.grad is not None:
            gradients[name] = relative_l2(got.grad, want.grad)
    return Comparison(
        forward=max(float(d.detach().max()) for d in differences),
        gradients=gradients,
        near_jumps=int((~safe).sum()),
        pixels=safe.numel(),
    )


def relative_l2(got: Tensor | None, want: Tensor) -> float:
    """Return the relative error ‖got - want‖ / ‖want‖ in float64; ‖got‖ where want is zero."""
    assert got is not None
    norm = float(want.double().norm())
    return float((got.double() - want.double()).norm()) / (norm if norm > 0 else 1.0)


def assert_alone_equal_together(
    gradients: Callable[[tuple[str, ...]], dict[str, Tensor | None]], names: tuple[str, ...], wanted: tuple[str, ...]
) -> None:
    """Assert that ``gradients`` of the inputs ``wanted`` are those of all ``names``, and that no other appears."""
    together, alone = gradients(names), gradients(wanted)
    for name in names:
        got, want = alone[name], together[name]
        if name not in wanted:
            assert got is None
        else:
            assert got is not None
            assert want is not None
            assert torch.equal(got, want), name


def pinhole(width: int, height: int, focal: float | None = None, views: int = 1) -> Tensor:
    """Return the intrinsics (views, 3, 3) with the principal point at the centre."""
    f = 0.9 * width if focal is None else focal
    K = torch.tensor([[f, 0.0, width / 2], [0.0, f, height / 2], [0.0, 0.0, 1.0]])
    return K.expand(views, 3, 3).contiguous()


def hard_scene(seed: int, n: int = 400, views: int = 1) -> Scene:
    """Return random Gaussians; a tenth each is behind the camera, below 0.1 px, opaque (>= 0.999), or off-screen."""
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g)

    width, height, tenth = 75, 53, n // 10
    means = normal(n, 3) * torch.tensor([1.0, 0.8, 1.0])
    scales = 10 ** (uniform(n, 3) * 2.5 - 3)
    opacities = uniform(n)
    means[:tenth, 2] -= 6.0
    scales[tenth : 2 * tenth] = 1e-3 * (0.1 + uniform(tenth, 3))  # at 2.5 m and f = 60 px below 0.03 px
    opacities[2 * tenth : 3 * tenth] = 0.999 + 1e-3 * uniform(tenth)
    means[3 * tenth : 4 * tenth, 0] += 6.0
    viewmats = torch.eye(4).repeat(views, 1, 1)
    for i in range(views):
        angle = torch.tensor(0.2 + 0.15 * i)
        viewmats[i, 0, 0] = viewmats[i, 2, 2] = angle.cos()
        viewmats[i, 0, 2], viewmats[i, 2, 0] = angle.sin(), -angle.sin()
        viewmats[i, :3, 3] = torch.tensor([0.1 * i, -0.05 * i, 2.5])
    K = torch.tensor([[60.0, 0.0, 0.55 * width], [0.0, 55.0, 0.45 * height], [0.0, 0.0, 1.0]])
    return Scene(
        means=means,
        quats=normal(n, 4),
        scales=scales,
        opacities=opacities,
        colors=uniform(n, 3),
        viewmats=viewmats,
        Ks=K.repeat(views, 1, 1),
        width=width,
        height=height,
        backgrounds=uniform(views, 3),
    )


def one_gaussian(
    *,
    mean: tuple[float, float, float] = (0.0, 0.0, 2.0),
    scale: tuple[float, float, float] = (0.05, 0.05, 0.05),
    opacity: float = 0.8,
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
    size: tuple[int, int] = (32, 24),
) -> Scene:
    """Return one orange Gaussian in front of an identity camera."""
    return Scene(
        means=torch.tensor([mean]),
        quats=torch.tensor([quat]),
        scales=torch.tensor([scale]),
        opacities=torch.tensor([opacity]),
        colors=torch.tensor([[1.0, 0.5, 0.25]]),
        viewmats=torch.eye(4)[None],
        Ks=pinhole(*size, focal=40.0),
        width=size[0],
        height=size[1],
    )
