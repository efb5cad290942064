"""The native selective Adam against torch.optim.Adam and float64."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.optimize.adam import adam_step
from splatbot.rasterize.native import native

SHAPES = {"a": (3,), "b": (4,), "c": (), "d": (16, 3)}
RATES = {"a": 1e-3, "b": 3e-3, "c": 5e-2, "d": 2e-3}

pytestmark = pytest.mark.usefixtures("one_torch_thread", "default_kernels")


class Run:
    """Parameters of n rows, their moments, and steps through the native kernel."""

    def __init__(self, n: int, seed: int = 0) -> None:
        self.random = torch.Generator().manual_seed(seed)
        self.values = {k: torch.randn(n, *s, generator=self.random) for k, s in SHAPES.items()}
        self.first = {k: torch.zeros_like(v) for k, v in self.values.items()}
        self.second = {k: torch.zeros_like(v) for k, v in self.values.items()}
        self.steps = torch.zeros(n)

    def gradients(self) -> dict[str, Tensor]:
        """Return gradients of sizes from 1e-6 to 1."""
        return {
            k: torch.randn(v.shape, generator=self.random) * 10 ** (-6 * torch.rand(v.shape, generator=self.random))
            for k, v in self.values.items()
        }

    def step(self, gradients: dict[str, Tensor], visible: Tensor, eps: float = 1e-15) -> None:
        """Perform one step in place."""
        adam_step(
            self.values, gradients, self.first, self.second, self.steps, visible, RATES, betas=(0.9, 0.99), eps=eps
        )


@pytest.mark.parametrize("n", [1, 17, 1023, 5000])
@pytest.mark.parametrize("eps", [1e-15, 1e-8])
def test_all_rows_step_as_torch_does(n: int, eps: float) -> None:
    run = Run(n)
    theirs = {k: v.double().requires_grad_() for k, v in run.values.items()}
    start = {k: v.clone() for k, v in run.values.items()}
    adam = torch.optim.Adam([{"params": [theirs[k]], "lr": RATES[k]} for k in SHAPES], betas=(0.9, 0.99), eps=eps)
    for _ in range(20):
        gradients = run.gradients()
        for k, p in theirs.items():
            p.grad = gradients[k].double()
        adam.step()
        run.step(gradients, torch.ones(n, dtype=torch.bool), eps)
    for k, p in theirs.items():
        moved = (p.detach() - start[k].double()).norm()
        assert float((run.values[k].double() - p.detach()).norm()) < 1e-4 * float(moved)
    assert torch.equal(run.steps, torch.full((n,), 20.0))


def test_a_rate_for_each_column_steps_as_separate_parameters_do() -> None:
    n = 1500
    whole, apart = Run(n), Run(n)
    width = whole.values["d"][0].numel()
    rates = [0.01 / (1 + c) for c in range(width)]
    for _ in range(5):
        gradient = whole.gradients()["d"]
        visible = torch.rand(n, generator=whole.random) < 0.7
        moments = ({"d": whole.first["d"]}, {"d": whole.second["d"]})
        values = {"d": whole.values["d"]}
        adam_step(values, {"d": gradient}, *moments, whole.steps, visible, {"d": rates}, betas=(0.9, 0.99), eps=1e-15)
        flat = gradient.reshape(n, width)
        for c in range(width):
            columns = {
                name: {"d": tensors["d"].reshape(n, width)[:, c].contiguous()}
                for name, tensors in (("values", apart.values), ("first", apart.first), ("second", apart.second))
            }
            steps = apart.steps.clone()
            column = {"d": flat[:, c].contiguous()}
            adam_step(
                columns["values"], column, columns["first"], columns["second"], steps, visible, {"d": rates[c]},
                betas=(0.9, 0.99), eps=1e-15,
            )  # fmt: skip
            for name, tensors in (("values", apart.values), ("first", apart.first), ("second", apart.second)):
                tensors["d"].reshape(n, width)[:, c] = columns[name]["d"]
        apart.steps = steps
        assert torch.equal(whole.first["d"], apart.first["d"])
        torch.testing.assert_close(whole.values["d"], apart.values["d"], rtol=1e-6, atol=1e-7)


def test_a_wrong_number_of_column_rates_is_refused() -> None:
    run = Run(3)
    with pytest.raises(InputError, match=r"has 2 rates.*give one, or 3"):
        adam_step(
            {"a": run.values["a"]}, run.gradients(), run.first, run.second, run.steps,
            torch.ones(3, dtype=torch.bool), {"a": [0.1, 0.2]}, betas=(0.9, 0.99), eps=1e-15,
        )  # fmt: skip


def test_rows_out_of_view_keep_their_bits_and_their_own_count_of_steps() -> None:
    n = 3000
    run = Run(n)
    alone = [Run(n), Run(n)]  # one for rows always seen, one for rows seen every other time
    every, other = torch.arange(n) % 3 == 0, torch.arange(n) % 3 == 1
    for i in range(12):
        gradients = run.gradients()
        before = {k: v.clone() for k, v in run.values.items()}
        visible = every | other if i % 2 else every
        run.step(gradients, visible)
        alone[0].step(gradients, torch.ones(n, dtype=torch.bool))
        if i % 2:
            alone[1].step(gradients, torch.ones(n, dtype=torch.bool))
        for k, value in run.values.items():
            assert torch.equal(value[~visible], before[k][~visible])
    for k, value in run.values.items():
        assert torch.equal(value[every], alone[0].values[k][every])
        assert torch.equal(value[other], alone[1].values[k][other])
        assert not run.first[k][~(every | other)].any()
    assert run.steps[:3].tolist() == [12.0, 6.0, 0.0]


def test_a_zero_gradient_from_the_start_moves_nothing() -> None:
    run = Run(50)
    before = {k: v.clone() for k, v in run.values.items()}
    run.step({k: torch.zeros_like(v) for k, v in run.values.items()}, torch.ones(50, dtype=torch.bool))
    assert all(torch.equal(run.values[k], before[k]) for k in before)


def test_many_steps_leave_the_bias_correction_at_one() -> None:
    run = Run(4)
    run.steps += 1e6
    gradients = {k: torch.ones_like(v) for k, v in run.values.items()}
    for k in SHAPES:
        run.first[k] += 1.0
        run.second[k] += 1.0
    before = run.values["a"].clone()
    run.step(gradients, torch.ones(4, dtype=torch.bool))
    assert torch.allclose(before - run.values["a"], torch.full((4, 3), RATES["a"]), rtol=1e-3)


def test_threads_change_no_bit() -> None:
    results = []
    for threads in (1, 2, 7):
        native().set_num_threads(threads)
        run = Run(9000, seed=5)
        for _ in range(3):
            run.step(run.gradients(), torch.rand(9000, generator=run.random) > 0.5)
        results.append(run.values)
    for values in results[1:]:
        assert all(torch.equal(values[k], results[0][k]) for k in SHAPES)


def test_no_rows_are_no_error() -> None:
    run = Run(0)
    run.step(run.gradients(), torch.zeros(0, dtype=torch.bool))
    assert len(run.values["a"]) == 0


def test_what_does_not_fit_is_refused_with_its_name() -> None:
    run = Run(6)
    good, everyone = run.gradients(), torch.ones(6, dtype=torch.bool)
    with pytest.raises(InputError, match="visible"):
        run.step(good, everyone[:5])
    with pytest.raises(InputError, match="visible"):
        run.step(good, everyone.float())
    with pytest.raises(InputError, match="b: has a gradient"):
        run.step({**good, "b": good["b"][:5]}, everyone)
    with pytest.raises(InputError, match="eps"):
        run.step(good, everyone, eps=0.0)
    run.values["a"] = run.values["a"].double()
    with pytest.raises(InputError, match="a: "):
        run.step(good, everyone)
    run.values["a"] = torch.randn(3, 6).T
    with pytest.raises(InputError, match="contiguous"):
        run.step(good, everyone)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("name", list(SHAPES))
def test_a_row_whose_gradient_is_not_finite_keeps_its_bits_and_is_counted(name: str, value: float) -> None:
    run, other = Run(1500), Run(1500)
    visible = torch.ones(1500, dtype=torch.bool)
    visible[100] = False
    gradients = run.gradients()
    rows = [0, 17, 1023, 1024, 1499]
    for row in [*rows, 100]:  # one that is not visible does not count
        gradients[name].view(1500, -1)[row, -1] = value
    skipped = adam_step(
        run.values, gradients, run.first, run.second, run.steps, visible, RATES, betas=(0.9, 0.99), eps=1e-15
    )
    assert skipped == len(rows)
    other.step({k: torch.nan_to_num(g, 0.0, 0.0, 0.0) for k, g in gradients.items()}, visible & ~_mask(rows))
    for mine, theirs in ((run.values, other.values), (run.first, other.first), (run.second, other.second)):
        assert all(torch.equal(mine[k], theirs[k]) for k in SHAPES)
    assert torch.equal(run.steps, other.steps)


def _mask(rows: list[int]) -> Tensor:
    mask = torch.zeros(1500, dtype=torch.bool)
    mask[rows] = True
    return mask
