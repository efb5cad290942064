"""The native L1 + D-SSIM loss against the same formula in torch's float64."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from splatbot.errors import InputError
from splatbot.evaluation import ssim
from splatbot.optimize.losses import Padding, l1_dssim
from splatbot.rasterize.native import native

pytestmark = pytest.mark.usefixtures("one_torch_thread", "default_kernels")


def reference(
    rendered: Tensor, target: Tensor, weight: float, padding: str = "same", mask: Tensor | None = None
) -> Tensor:
    """Compute the loss by torch's convolution, in float64; images (C, H, W, D)."""
    x, y = rendered.double(), target.double()
    keep = torch.ones(x.shape[:-1]) if mask is None else mask.double()
    x = torch.where(keep[..., None] > 0, x, y)
    d = torch.arange(11, dtype=torch.float64) - 5
    g = torch.exp(-0.5 * (d / 1.5) ** 2)
    g = g / g.sum()

    def blur(image: Tensor) -> Tensor:
        planes = image.permute(0, 3, 1, 2).reshape(-1, 1, *image.shape[1:3])
        p = 5 if padding == "same" else 0
        return F.conv2d(F.conv2d(planes, g.view(1, 1, 1, 11), padding=(0, p)), g.view(1, 1, 11, 1), padding=(p, 0))

    m1, m2 = blur(x), blur(y)
    v1, v2, v12 = blur(x * x) - m1**2, blur(y * y) - m2**2, blur(x * y) - m1 * m2
    values = (2 * m1 * m2 + 1e-4) * (2 * v12 + 9e-4) / ((m1**2 + m2**2 + 1e-4) * (v1 + v2 + 9e-4))
    inside = keep if padding == "same" else keep[:, 5:-5, 5:-5]
    weights = inside[:, None].expand(-1, x.shape[-1], -1, -1).reshape(values.shape).double()
    mean_l1 = ((x - y).abs() * keep[..., None]).sum() / (keep.sum() * x.shape[-1])
    return (1 - weight) * mean_l1 + weight * (1 - (values * weights).sum() / weights.sum())


def photo(*shape: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return a smooth random image with a flat part, and a noisy copy."""
    g = torch.Generator().manual_seed(seed)
    small = torch.rand(shape[0], shape[3], 8, 8, generator=g)
    image = F.interpolate(small, size=shape[1:3], mode="bilinear").permute(0, 2, 3, 1).contiguous()
    image[:, : shape[1] // 3] = 0.4
    return (image + 0.05 * torch.randn(shape, generator=g)).clamp(0, 1), image


def both(
    rendered: Tensor, target: Tensor, weight: float = 0.2, padding: Padding = "same", mask: Tensor | None = None
) -> tuple[float, float]:
    """Return the differences of value and gradient (relative L2) from the reference."""
    x, exact = rendered.clone().requires_grad_(), rendered.double().requires_grad_()
    value = l1_dssim(x, target, weight, mask, padding=padding)
    want = reference(exact, target, weight, padding, mask)
    (got_grad,) = torch.autograd.grad(value, x)
    (want_grad,) = torch.autograd.grad(want, exact)
    error = float((got_grad.double() - want_grad).norm() / want_grad.norm().clamp_min(1e-30))
    return abs(float(value.detach()) - float(want.detach())), error


@pytest.mark.parametrize("padding", ["same", "valid"])
@pytest.mark.parametrize("shape", [(1, 480, 640, 3), (2, 65, 257, 3), (1, 11, 300, 1), (1, 130, 40, 7)])
def test_value_and_gradient_are_those_of_the_convolution(shape: tuple[int, ...], padding: Padding) -> None:
    value, gradient = both(*photo(*shape), padding=padding)
    assert value < 1e-6
    assert gradient < 1e-5


@pytest.mark.parametrize("weight", [0.0, 0.5, 1.0])
def test_the_weight_shares_the_loss_between_its_terms(weight: float) -> None:
    value, gradient = both(*photo(1, 40, 50, 3), weight=weight)
    assert value < 1e-6
    assert gradient < 1e-5


@pytest.mark.parametrize("shape", [(1, 1, 1, 3), (1, 5, 7, 3), (1, 1, 200, 3), (1, 200, 2, 3), (1, 10, 10, 1)])
def test_an_image_smaller_than_the_window_is_padded(shape: tuple[int, ...]) -> None:
    g = torch.Generator().manual_seed(2)
    value, gradient = both(torch.rand(shape, generator=g), torch.rand(shape, generator=g))
    assert value < 1e-5
    assert gradient < 1e-3


@pytest.mark.parametrize("padding", ["same", "valid"])
def test_flat_images_keep_the_digits_that_float32_moments_lose(padding: Padding) -> None:
    """Plain float32 has an error of 5e-5 here: variances are differences of moments 1e7 times as large."""
    value, gradient = both(torch.full((1, 60, 80, 3), 0.7), torch.full((1, 60, 80, 3), 0.65), padding=padding)
    assert value < 1e-6
    assert gradient < 1e-4


def test_equal_images_cost_nothing_and_pull_nowhere() -> None:
    _, image = photo(1, 50, 60, 3)
    rendered = image.clone().requires_grad_()
    value = l1_dssim(rendered, image)
    value.backward()
    assert abs(float(value.detach())) < 1e-6
    assert rendered.grad is not None
    assert float(rendered.grad.abs().max()) < 1e-8


@pytest.mark.parametrize("padding", ["same", "valid"])
def test_a_mask_counts_only_its_pixels(padding: Padding) -> None:
    rendered, target = photo(2, 70, 90, 3)
    mask = torch.zeros(2, 70, 90, dtype=torch.bool)
    mask[0, 10:40, 20:70] = True
    mask[1, 3:60:2] = True
    value, gradient = both(rendered, target, padding=padding, mask=mask)
    assert value < 1e-6
    assert gradient < 1e-5
    changed = torch.where(mask[..., None], rendered, torch.full_like(rendered, torch.nan))
    assert torch.equal(
        l1_dssim(changed, target, mask=mask, padding=padding), l1_dssim(rendered, target, mask=mask, padding=padding)
    )


def test_an_empty_mask_gives_zero_and_no_gradient() -> None:
    rendered, target = photo(1, 20, 30, 3)
    rendered = rendered.requires_grad_()
    value = l1_dssim(rendered, target, mask=torch.zeros(1, 20, 30, dtype=torch.bool))
    value.backward()
    assert float(value.detach()) == 0.0
    assert rendered.grad is not None
    assert not rendered.grad.any()


def test_one_image_without_a_leading_dimension_is_the_same_loss() -> None:
    rendered, target = photo(1, 30, 40, 3)
    assert torch.equal(l1_dssim(rendered[0], target[0]), l1_dssim(rendered, target))
    assert torch.equal(
        l1_dssim(rendered[0].permute(1, 0, 2), target[0].permute(1, 0, 2)),
        l1_dssim(rendered[0].permute(1, 0, 2).contiguous(), target[0].permute(1, 0, 2).contiguous()),
    )


def test_structure_is_that_of_the_evaluation() -> None:
    rendered, target = photo(1, 64, 64, 3)
    want = 1.0 - ssim(rendered[0].numpy(), target[0].numpy())
    assert float(l1_dssim(rendered, target, 1.0, padding="valid")) == pytest.approx(want, abs=1e-6)


def test_the_upstream_gradient_scales_and_a_retained_graph_repeats() -> None:
    rendered, target = photo(1, 30, 40, 3)
    rendered.requires_grad_()
    loss = l1_dssim(rendered, target)
    (once,) = torch.autograd.grad(loss, rendered, retain_graph=True)
    kept = once.clone()
    once.zero_()  # the caller may do so: it is the caller's
    (twice,) = torch.autograd.grad(loss, rendered, retain_graph=True)
    (scaled,) = torch.autograd.grad(-3.0 * loss, rendered)
    assert torch.equal(twice, kept)
    assert torch.allclose(scaled, -3.0 * kept, rtol=1e-6)


def test_threads_change_no_bit_and_instruction_sets_only_rounding() -> None:
    rendered, target = photo(2, 200, 700, 3)
    mask = torch.rand(2, 200, 700, generator=torch.Generator().manual_seed(3)) > 0.1
    results = []
    for isa in native().available_isas():
        native().set_isa(isa)
        for threads in (1, 2, 5):
            native().set_num_threads(threads)
            x = rendered.clone().requires_grad_()
            value = l1_dssim(x, target, mask=mask)
            results.append((isa, float(value.detach()), torch.autograd.grad(value, x)[0]))
    for isa, loss, gradient in results:
        same = next(r for r in results if r[0] == isa)
        assert loss == same[1]
        assert torch.equal(gradient, same[2])
        assert abs(loss - results[0][1]) < 1e-7
        assert float((gradient - results[0][2]).norm() / gradient.norm()) < 1e-5


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("field", ["rendered", "target"])
def test_a_value_that_is_not_finite_is_named(field: str, bad: float) -> None:
    rendered, target = photo(2, 40, 50, 3)
    (rendered if field == "rendered" else target)[1, 7, 49, 2] = bad
    with pytest.raises(InputError, match=f"{field}: image 1, row 7, column 49, channel 2"):
        l1_dssim(rendered, target)


def test_values_whose_squares_overflow_are_refused() -> None:
    with pytest.raises(InputError, match="too large"):
        l1_dssim(torch.full((12, 12, 3), 1e30), torch.rand(12, 12, 3))


def test_what_does_not_fit_is_refused_with_its_name() -> None:
    x = torch.rand(20, 20, 3)
    with pytest.raises(InputError, match="target: is"):
        l1_dssim(x, x[:10])
    with pytest.raises(InputError, match=r"rendered.*float"):
        l1_dssim(x.double(), x.double())
    with pytest.raises(InputError, match="mask"):
        l1_dssim(x, x, mask=torch.ones(20, 20))
    with pytest.raises(InputError, match=r"target\.detach"):
        l1_dssim(x, x.clone().requires_grad_())
    with pytest.raises(InputError, match="'valid' needs 11"):
        l1_dssim(x[:8], x[:8], padding="valid")
    with pytest.raises(InputError, match="weight"):
        l1_dssim(x, x, weight=1.5)
    with pytest.raises(InputError, match="padding"):
        l1_dssim(x, x, padding="mirror")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="not empty"):
        l1_dssim(x[:0], x[:0])
