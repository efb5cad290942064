"""gsplat's interface: layouts of tensors and of meta, gradients of projected centres, tiles.

Each is checked against closed forms, plain torch or the float64 reference.
"""

from __future__ import annotations

import gc
import math
import sys
import weakref
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize import rasterization
from splatbot.rasterize.intersections import isect_offset_encode, isect_tiles
from tests.scenes import Scene, hard_scene, one_gaussian, relative_l2

LEAVES = ("means", "quats", "scales", "opacities", "colors")


def call(scene: Scene, **options: Any) -> tuple[Tensor, Tensor, Any]:
    return rasterization(**{**vars(scene), **options})


# --- projection -------------------------------------------------------------------------------------------------------


def test_the_pinhole_projection_is_that_of_the_closed_form() -> None:
    scene = one_gaussian(mean=(0.3, -0.2, 2.0), scale=(0.05, 0.05, 0.05))
    meta = call(scene, packed=False)[2]
    assert meta["means2d"][0, 0].tolist() == pytest.approx([40 * 0.15 + 16, 40 * -0.1 + 12], rel=1e-6)
    assert float(meta["depths"]) == pytest.approx(2.0)
    x, y, s = 0.15, -0.1, (40 * 0.05 / 2) ** 2  # J J^T times the variance, J = f/z (1 0 -x; 0 1 -y)
    cov = torch.tensor([[s * (1 + x * x) + 0.3, s * x * y], [s * x * y, s * (1 + y * y) + 0.3]], dtype=torch.float64)
    inverse = torch.linalg.inv(cov)
    want = [float(inverse[0, 0]), float(inverse[0, 1]), float(inverse[1, 1])]
    assert meta["conics"][0, 0].tolist() == pytest.approx(want, rel=1e-5)
    sigmas = min(3.33, math.sqrt(2 * math.log(255 * 0.8)))
    assert meta["radii"][0, 0].tolist() == [math.ceil(sigmas * math.sqrt(float(cov[i, i]))) for i in range(2)]


def test_a_gaussian_whose_box_of_whole_pixels_meets_the_image_is_in_view() -> None:
    for x, seen in ((-16.0 - 4.6, True), (-16.0 - 5.6, False)):  # the ellipse reaches 4.1 px, the box 5
        scene = one_gaussian(mean=(x / 20.0, 0.0, 2.0))
        meta = call(scene, packed=False)[2]
        assert bool(meta["visibility"][0, 0]) is seen
        assert int(meta["contributions"][0, 0]) == 0


def test_the_example_of_one_gaussian_on_the_near_plane_renders() -> None:
    mean = torch.zeros((1, 3))
    mean[:, 2] = 0.01
    quat = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    color, opacity, scale = torch.rand((1, 3)), torch.ones((1,)), 0.5 + 0.5 * torch.rand((1, 3))
    K = torch.tensor([[[1.0, 0.0, 120.0], [0.0, 1.0, 120.0], [0.0, 0.0, 1.0]]])
    image, alpha, meta = rasterization(mean, quat, scale, opacity, color, torch.eye(4)[None], K, 240, 240)
    assert image.shape == (1, 240, 240, 3)
    assert bool(torch.isfinite(image).all())
    assert float(alpha.max()) == pytest.approx(0.99, abs=1e-5)
    assert torch.allclose(image[0, 120, 120] / alpha[0, 120, 120], color[0], atol=1e-5)
    assert meta["gaussian_ids"].tolist() == [0]


# --- batches ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["colors", "view colors", "harmonics"])
def test_batches_render_as_their_scenes_one_by_one(kind: str) -> None:
    scenes = [hard_scene(seed, n=120, views=2) for seed in range(6)]
    options: dict[str, Any] = {"render_mode": "RGB+ED"}
    for i, scene in enumerate(scenes):
        generator = torch.Generator().manual_seed(i)
        if kind == "view colors":
            scene.colors = torch.rand(2, 120, 3, generator=generator)
        if kind == "harmonics":
            scene.colors = torch.rand(120, 4, 3, generator=generator)
            options["sh_degree"] = 1
    names = (*LEAVES, "viewmats", "Ks", "backgrounds")
    single: dict[str, list[Tensor]] = {name: [] for name in names}
    images = []
    for scene in scenes:
        leaves = scene.to(torch.float32, requires_grad=True)
        image, alpha, _ = call(leaves, **options)
        ((image**2).sum() + alpha.sum()).backward()
        images.append(image.detach())
        for name in names:
            single[name].append(getattr(leaves, name).grad)
    batched = {
        name: torch.stack([getattr(s, name) for s in scenes]).unflatten(0, (2, 3)).requires_grad_() for name in names
    }
    size = {"width": scenes[0].width, "height": scenes[0].height}
    image, alpha, meta = rasterization(**batched, **size, **options)  # type: ignore[arg-type]
    assert image.shape == (2, 3, 2, 53, 75, 4)
    assert alpha.shape == (2, 3, 2, 53, 75, 1)
    assert torch.equal(image.detach().flatten(0, 1), torch.stack(images))
    ((image**2).sum() + alpha.sum()).backward()
    for name in names:
        got = batched[name].grad
        assert got is not None
        assert torch.equal(got.flatten(0, 1), torch.stack(single[name])), name
    assert (meta["n_batches"], meta["n_cameras"]) == (6, 2)
    dense = rasterization(**batched, **size, **options, packed=False)[2]  # type: ignore[arg-type]
    assert dense["radii"].shape == (2, 3, 2, 120, 2)
    rows = meta["batch_ids"], meta["camera_ids"], meta["gaussian_ids"]
    for key in ("radii", "means2d", "depths", "conics", "opacities"):
        assert torch.equal(meta[key], dense[key].flatten(0, 1)[rows]), key


def test_no_views_give_no_images() -> None:
    scene = hard_scene(1, n=20)
    scene.viewmats, scene.Ks, scene.backgrounds = torch.zeros(0, 4, 4), torch.zeros(0, 3, 3), None
    image, alpha, meta = call(scene)
    assert (image.shape, alpha.shape) == ((0, 53, 75, 3), (0, 53, 75, 1))
    assert meta["means2d"].shape == (0, 2)


# --- packed and dense meta --------------------------------------------------------------------------------------------


def test_packed_meta_holds_the_rows_in_view_of_the_dense_one() -> None:
    scene = hard_scene(2, views=3)
    image, _, packed = call(scene, packed=True)
    same, _, dense = call(scene, packed=False)
    assert torch.equal(image, same)
    views, ids = torch.where((dense["radii"] > 0).all(-1))
    assert 0 < len(ids) < 3 * 400
    assert torch.equal(packed["camera_ids"], views)
    assert torch.equal(packed["gaussian_ids"], ids)
    assert packed["batch_ids"].tolist() == [0] * len(ids)
    for key in ("radii", "means2d", "depths", "conics", "opacities", "tiles_per_gauss"):
        assert torch.equal(packed[key], dense[key][views, ids]), key
    assert dense["gaussian_ids"] is None
    assert torch.equal(packed["visibility"], dense["visibility"])
    assert torch.equal(dense["opacities"], scene.opacities.expand(3, -1))


def test_meta_has_gsplats_keys_and_takes_more() -> None:
    meta = call(one_gaussian())[2]
    keys = "batch_ids camera_ids gaussian_ids radii means2d depths conics opacities tile_width tile_height"
    keys += " tiles_per_gauss isect_ids flatten_ids isect_offsets width height tile_size n_batches n_cameras"
    for key in keys.split():
        assert key in meta
        meta[key]
    meta["mine"] = 3
    assert meta["mine"] == 3
    assert len(meta) == len(list(meta)) == len(dict(meta))
    del meta["mine"]
    assert "mine" not in meta
    with pytest.raises(KeyError):
        meta["mine"]


def test_an_empty_scene_has_empty_meta() -> None:
    scene = hard_scene(3, n=0, views=2)
    meta = call(scene, packed=False)[2]
    assert meta["radii"].shape == (2, 0, 2)
    assert meta["isect_offsets"].tolist() == torch.zeros(2, 4, 5).tolist()
    assert meta["contributions"].shape == (2, 0)
    assert call(scene)[2]["gaussian_ids"].shape == (0,)


# --- tiles ------------------------------------------------------------------------------------------------------------


def test_tile_intersections_equal_a_plain_loop() -> None:
    meta = call(hard_scene(4, views=2), packed=False, tile_size=8)[2]
    columns, rows = meta["tile_width"], meta["tile_height"]
    assert (columns, rows) == (10, 7)
    pairs = []
    for view in range(2):
        for i in range(400):
            (rx, ry), (x, y) = meta["radii"][view, i].tolist(), meta["means2d"][view, i].tolist()
            boxes = 0
            if rx > 0 and ry > 0:
                for ty in range(max(0, math.floor((y - ry) / 8)), min(rows, math.ceil((y + ry) / 8))):
                    for tx in range(max(0, math.floor((x - rx) / 8)), min(columns, math.ceil((x + rx) / 8))):
                        pairs.append((view, ty * columns + tx, float(meta["depths"][view, i]), view * 400 + i))
                        boxes += 1
            assert int(meta["tiles_per_gauss"][view, i]) == boxes
    pairs.sort()
    assert meta["flatten_ids"].tolist() == [p[3] for p in pairs]
    offsets = meta["isect_offsets"].flatten().tolist()
    assert offsets == [sum((p[0], p[1]) < (t // 70, t % 70) for p in pairs) for t in range(140)]


def test_ids_of_intersections_hold_image_tile_and_depth() -> None:
    means2d, radii = torch.tensor([[[8.0, 8.0]], [[24.0, 8.0]]]), torch.full((2, 1, 2), 2, dtype=torch.int32)
    count, ids, flat = isect_tiles(means2d, radii, torch.tensor([[1.0], [2.0]]), 16, 2, 2)
    assert count.tolist() == [[1], [1]]
    assert flat.tolist() == [0, 1]
    one, two = 0x3F800000, 0x40000000
    assert ids.tolist() == [one, (1 << 35) | (1 << 32) | two]
    assert isect_offset_encode(ids, 2, 2, 2).tolist() == [[[0, 1], [1, 1]], [[1, 1], [2, 2]]]


def test_masked_tiles_show_the_background_and_give_no_gradient() -> None:
    scene = hard_scene(5, views=2).to(torch.float32, requires_grad=True)
    masks = torch.rand(2, 4, 5, generator=torch.Generator().manual_seed(0)) > 0.4
    pixels = masks.repeat_interleave(16, 1).repeat_interleave(16, 2)[:, :53, :75, None]
    image, alpha, meta = call(scene, masks=masks, render_mode="RGB+D")
    full, full_alpha, _ = call(scene, render_mode="RGB+D")
    assert scene.backgrounds is not None
    behind = torch.nn.functional.pad(scene.backgrounds, (0, 1))[:, None, None]
    assert torch.equal(image, torch.where(pixels, full, behind))
    assert torch.equal(alpha, torch.where(pixels, full_alpha, torch.zeros(())))
    names = (*LEAVES, "viewmats", "backgrounds")
    leaves = [getattr(scene, name) for name in names]
    got = torch.autograd.grad((image**2).sum() + alpha.sum(), leaves)
    want = torch.autograd.grad((torch.where(pixels, full, behind) ** 2).sum() + (full_alpha * pixels).sum(), leaves)
    for name, g, w in zip(names, got, want, strict=True):
        assert relative_l2(g, w) <= 1e-5, name
    assert 0 < int(meta["contributions"].sum()) < int(call(scene)[2]["contributions"].sum())


def test_contributions_count_the_pixels_of_the_reference() -> None:
    scene = hard_scene(6, n=100)
    counts = call(scene)[2]["contributions"][0]
    exact = scene.to(torch.float64)
    exact.colors = torch.eye(100, dtype=torch.float64)
    exact.backgrounds = None
    weights, _, meta = exact.reference_leaves("RGB")
    want = (weights[0] > 0).sum((0, 1))
    near_jumps = int((meta.margins < 2e-5).sum())
    assert int((counts - want).abs().sum()) <= near_jumps
    assert int(counts.sum()) > 1000


# --- gradients of the projected centres -------------------------------------------------------------------------------


def test_the_centres_keep_the_gradient_of_the_image() -> None:
    """Isotropic Gaussians far before a long lens: moving one sideways moves its centre alone, to first order."""
    generator = torch.Generator().manual_seed(0)
    scene = hard_scene(7, n=40)
    focal = 40_000.0
    scene.viewmats = torch.eye(4)[None]
    scene.Ks = torch.tensor([[[focal, 0.0, 37.5], [0.0, focal, 26.5], [0.0, 0.0, 1.0]]])
    depth = 1000.0 + 10.0 * torch.rand(40, 1, generator=generator)
    scene.means = torch.cat([0.4 * torch.randn(40, 2, generator=generator), depth], 1)
    scene.scales = (0.02 + 0.1 * torch.rand(40, 1, generator=generator)).expand(40, 3).contiguous()
    exact = scene.to(torch.float64, requires_grad=True)
    image, _, meta = exact.reference_leaves("RGB")
    weights = torch.randn(image.shape, generator=generator) * (meta.margins > 1e-4)[..., None]
    (image * weights).sum().backward()
    assert exact.means.grad is not None
    want = exact.means.grad[:, :2] * exact.means[:, 2:].detach() / focal  # [1/m] to [1/px]
    leaves = scene.to(torch.float32, requires_grad=True)
    image, _, info = call(leaves, packed=False)
    info["means2d"].retain_grad()
    (image * weights).sum().backward()
    assert relative_l2(info["means2d"].grad[0], want) <= 1e-3


def test_absolute_gradients_are_sums_over_pixels_of_absolute_gradients() -> None:
    scene = hard_scene(8, n=25)
    scene.width, scene.height = 9, 7
    scene.Ks[:, :2] *= 0.12
    weights = torch.randn(1, 7, 9, 3, generator=torch.Generator().manual_seed(0))
    want = torch.zeros(1, 25, 2)
    image, _, meta = call(scene.to(torch.float32, requires_grad=True), packed=False)
    for y in range(7):
        for x in range(9):
            alone = (image[:, y, x] * weights[:, y, x]).sum()
            want += torch.autograd.grad(alone, meta["means2d"], retain_graph=True)[0].abs()
    image, _, meta = call(scene.to(torch.float32, requires_grad=True), packed=False, absgrad=True)
    (image * weights).sum().backward()
    assert float(want.max()) > 0.01
    assert relative_l2(meta["means2d"].absgrad, want) <= 1e-5


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("absgrad", [True, False])
def test_a_densification_strategy_written_for_gsplat_finds_what_it_needs(packed: bool, absgrad: bool) -> None:
    scene = hard_scene(9, views=2).to(torch.float32, requires_grad=True)
    image, _, info = call(scene, packed=packed, absgrad=absgrad)
    info["means2d"].retain_grad()
    (image**2).mean().backward()
    grads = (info["means2d"].absgrad if absgrad else info["means2d"].grad).clone()
    grads[..., 0] *= info["width"] / 2.0 * info["n_cameras"]
    grads[..., 1] *= info["height"] / 2.0 * info["n_cameras"]
    if packed:
        ids, radii = info["gaussian_ids"], info["radii"].max(dim=-1).values
    else:
        seen = (info["radii"] > 0).all(dim=-1)
        ids, grads, radii = torch.where(seen)[1], grads[seen], info["radii"][seen].max(dim=-1).values
    total, count = torch.zeros(400), torch.zeros(400)
    total.index_add_(0, ids, grads.norm(dim=-1))
    count.index_add_(0, ids, torch.ones_like(ids, dtype=torch.float32))
    largest = torch.zeros(400)
    largest[ids] = torch.maximum(largest[ids], radii / float(max(info["width"], info["height"])))
    assert set(count.tolist()) == {0.0, 1.0, 2.0}
    assert float(total[count == 0].abs().max()) == 0.0
    assert float((total / count.clamp_min(1)).max()) > 0.0
    assert float(largest.max()) > 0.05


def test_a_loss_on_the_centres_reaches_means_and_cameras_besides_that_of_the_image() -> None:
    def gradients(*parts: str, packed: bool = True) -> list[Tensor]:
        scene = hard_scene(10, views=2).to(torch.float32, requires_grad=True)
        image, _, meta = call(scene, packed=packed)
        centres = meta["means2d"] if packed else meta["means2d"][meta["visibility"]]
        loss = torch.zeros(())
        if "image" in parts:
            loss = loss + (image**2).mean()
        if "centres" in parts:
            loss = loss + (centres**2).mean() * 1e-3
        return list(torch.autograd.grad(loss, [scene.means, scene.viewmats, scene.Ks]))

    image, centres, both = gradients("image"), gradients("centres"), gradients("image", "centres")
    for i, c, b, dense in zip(image, centres, both, gradients("image", "centres", packed=False), strict=True):
        assert float(c.norm()) > 0.0
        assert relative_l2(b, (i.double() + c.double())) <= 1e-5
        assert relative_l2(dense, b) <= 1e-5
    scene = hard_scene(10, views=2).to(torch.float64, requires_grad=True)
    seen = call(hard_scene(10, views=2), packed=False)[2]["visibility"]
    exact = (scene.reference_leaves("RGB")[2].means2d[seen] ** 2).mean() * 1e-3
    for got, want in zip(centres, torch.autograd.grad(exact, [scene.means, scene.viewmats, scene.Ks]), strict=True):
        assert relative_l2(got, want) <= 1e-4


def test_centres_that_nobody_asks_for_are_not_computed_and_change_no_gradient() -> None:
    def gradient(ask: bool) -> tuple[Tensor, Any]:
        scene = hard_scene(11).to(torch.float32, requires_grad=True)
        image, _, meta = call(scene)
        if ask:
            meta["means2d"].retain_grad()
        image.sum().backward()
        return scene.means.grad, meta  # type: ignore[return-value]

    (asked, with_grad), (silent, without) = gradient(True), gradient(False)
    assert torch.equal(asked, silent)
    assert with_grad["means2d"].grad is not None
    assert not hasattr(without["means2d"], "absgrad")


def test_a_render_that_is_let_go_frees_its_memory_at_once() -> None:
    scene = hard_scene(12).to(torch.float32, requires_grad=True)
    gc.collect()
    gc.disable()
    try:
        image, _, meta = call(scene, absgrad=True)
        centres = meta["means2d"]
        centres.retain_grad()
        image.sum().backward()
        dead = [weakref.ref(image), weakref.ref(centres), weakref.ref(meta)]
        del image, centres, meta
        assert [d() for d in dead] == [None, None, None]
    finally:
        gc.enable()


# --- sparse gradients -------------------------------------------------------------------------------------------------


def test_sparse_gradients_hold_the_rows_in_view_of_the_dense_ones() -> None:
    dense, sparse = (hard_scene(13, views=2).to(torch.float32, requires_grad=True) for _ in range(2))
    (call(dense)[0] ** 2).sum().backward()
    image, _, meta = call(sparse, sparse_grad=True)
    (image**2).sum().backward()
    for name in ("means", "quats", "scales"):
        grad = getattr(sparse, name).grad
        assert grad.is_sparse
        assert torch.equal(grad.to_dense(), getattr(dense, name).grad)
        assert torch.equal(grad.coalesce().indices()[0], meta["gaussian_ids"].unique())
    assert not sparse.opacities.grad.is_sparse  # type: ignore[union-attr]
    assert torch.equal(sparse.opacities.grad, dense.opacities.grad)  # type: ignore[arg-type]
    optimizer = torch.optim.SparseAdam([sparse.means], lr=0.1)
    before = sparse.means.detach().clone()
    optimizer.step()
    moved = (sparse.means.detach() != before).any(-1)
    assert 0 < int(moved.sum()) < 400


# --- gsplat itself ----------------------------------------------------------------------------------------------------


def test_the_gsplat_backend_hands_the_same_call_over(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def record(**arguments: Any) -> tuple[str, str, str]:
        calls.append(arguments)
        return "colors", "alphas", "meta"

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=record))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    scene = hard_scene(14)
    options = {
        "backend": "gsplat",
        "absgrad": True,
        "render_mode": "RGB+ED",
        "with_ut": True,
        "camera_model": "fisheye",
    }
    assert call(scene, **options) == ("colors", "alphas", "meta")
    (arguments,) = calls
    for name in (*LEAVES, "viewmats", "Ks", "backgrounds", "covars", "width", "height"):
        assert arguments[name] is getattr(scene, name), name
    assert (arguments["absgrad"], arguments["render_mode"]) == (True, "RGB+ED")
    assert (arguments["with_ut"], arguments["camera_model"], arguments["packed"]) == (True, "fisheye", True)
    assert not {"backend", "depth_mode", "masks", "absent"} & set(arguments)
    with pytest.raises(InputError) as caught:
        call(scene, backend="gsplat", depth_mode="plane")
    assert caught.value.field == "depth_mode"


def test_the_gsplat_backend_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(InputError, match="pip install gsplat"):
        call(one_gaussian(), backend="gsplat")
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace())
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="CUDA device"):
        call(one_gaussian(), backend="gsplat")
