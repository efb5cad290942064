"""Adam over the arrays of a Gaussian model that grows and shrinks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.rasterize.native import native

Rate = float | Sequence[float]
"""A learning rate: one, or one for each value of a row."""

PARAMETERS = ("means", "quats", "log_scales", "opacity_logits", "sh")


class GaussianAdam:
    """Adam (Kingma & Ba 2015) with one learning rate per kind of parameter; moments follow the Gaussians.

    Each Gaussian counts its own steps, so that the bias of a new one's moments is corrected as its own.
    """

    betas = (0.9, 0.99)
    eps = 1e-15

    def __init__(self, rates: Mapping[str, Rate]) -> None:
        self.rates = dict(rates)
        self.steps = torch.zeros(0)
        self.skipped = 0
        """Rows that were not stepped because their gradient was not finite, over all steps."""
        self.first: dict[str, Tensor] = {}
        self.second: dict[str, Tensor] = {}

    def extend(self, model: GaussianModel) -> None:
        """Add moments of zero for rows that were appended to ``model``."""
        n = len(model) - len(self.steps)
        self.steps = torch.cat([self.steps, torch.zeros(n)])
        for name in PARAMETERS:
            shape = getattr(model, name).shape[1:]
            for moments in (self.first, self.second):
                old = moments.get(name, torch.zeros(0, *shape))
                moments[name] = torch.cat([old, torch.zeros(n, *shape)])

    def select(self, index: Tensor) -> None:
        """Keep the rows that ``index`` names, as :meth:`GaussianModel.select` does."""
        self.steps = self.steps[index]
        for moments in (self.first, self.second):
            for name in PARAMETERS:
                moments[name] = moments[name][index]

    def forget(self, rows: Tensor, names: Sequence[str] = PARAMETERS) -> None:
        """Set the moments of these rows to zero; with all parameters, their counts of steps too."""
        for moments in (self.first, self.second):
            for name in names:
                moments[name][rows] = 0.0
        if set(names) == set(PARAMETERS):
            self.steps[rows] = 0.0

    def state(self) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        """Return the moments and counts, shared: a step changes them, :meth:`extend` and :meth:`select` copy."""
        return self.steps, dict(self.first), dict(self.second)

    def restore(self, state: tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]) -> None:
        """Go back to a :meth:`state`."""
        self.steps, self.first, self.second = state[0], dict(state[1]), dict(state[2])

    @torch.no_grad()
    def step(self, model: GaussianModel, grads: Mapping[str, Tensor], visible: Tensor) -> None:
        """Perform one step in place on the rows that ``visible`` (N,) marks; the others keep their bits.

        Raises:
            InputError: ``visible`` or a gradient does not fit the model, or rows came without :meth:`extend`.
        """
        if len(self.steps) != len(model):
            raise InputError(
                f"knows {len(self.steps)} rows of {len(model)}.", field="adam", hint="call extend() or select() first"
            )
        self.skipped += adam_step(
            {name: getattr(model, name) for name in grads},
            grads,
            self.first,
            self.second,
            self.steps,
            visible,
            self.rates,
            betas=self.betas,
            eps=self.eps,
        )


def adam_step(
    parameters: Mapping[str, Tensor],
    grads: Mapping[str, Tensor],
    first: Mapping[str, Tensor],
    second: Mapping[str, Tensor],
    steps: Tensor,
    visible: Tensor,
    rates: Mapping[str, Rate],
    *,
    betas: tuple[float, float],
    eps: float,
) -> int:
    """Perform one step of Adam in place, natively, on the rows that ``visible`` marks and whose gradient is finite.

    Args:
        parameters: (N, ...) each, float32, contiguous; changed in place, as are the moments.
        grads: of each parameter; ``first`` and ``second``: its moments, all of its shape.
        steps: (N,) float32, the number of steps each row has taken; counted up for the visible ones.
        visible: (N,) bool.
        rates: learning rate of each parameter; one, or one for each value of a row.
        betas: decay of the two moments.
        eps: added to the root of the second moment, > 0.

    Returns:
        the number of rows that were left alone because a gradient of theirs is not finite.

    Raises:
        InputError: a shape, type or layout does not fit.
    """
    n = len(steps)
    if visible.dtype != torch.bool or visible.shape != (n,):
        raise InputError(f"is {tuple(visible.shape)}, {visible.dtype}.", field="visible", hint=f"give bool ({n},)")
    if not eps > 0.0:
        raise InputError(f"is {eps}.", field="eps", hint="give a positive number; 0 divides by 0 at a zero gradient")
    names = list(parameters)
    for name in names:
        _check(name, parameters[name], n)
        for what, tensors in (("gradient", grads), ("first moment", first), ("second moment", second)):
            if tensors[name].shape != parameters[name].shape or tensors[name].dtype != torch.float32:
                got = f"{tuple(tensors[name].shape)}, {tensors[name].dtype}"
                raise InputError(f"has a {what} of {got}.", field=name, hint="give the parameter's shape, float32")
        for moments in (first, second):
            _check(name, moments[name], n)
    skipped: int = native().adam_step(
        [parameters[name].detach() for name in names],
        [grads[name].detach().contiguous() for name in names],
        [first[name] for name in names],
        [second[name] for name in names],
        [_row_rates(name, rates[name], parameters[name]) for name in names],
        visible.contiguous().view(torch.uint8),
        steps,
        *betas,
        eps,
    )
    return skipped


def _row_rates(name: str, rate: Rate, parameter: Tensor) -> list[float]:
    if isinstance(rate, (int, float)):
        return [float(rate)]
    columns = parameter[0].numel() if len(parameter) else len(rate)
    if len(rate) != columns:
        raise InputError(f"has {len(rate)} rates.", field=name, hint=f"give one, or {columns}: one for each value")
    return [float(r) for r in rate]


def _check(name: str, tensor: Tensor, rows: int) -> None:
    if tensor.ndim == 0 or len(tensor) != rows:
        raise InputError(f"is {tuple(tensor.shape)}.", field=name, hint=f"give {rows} rows")
    if tensor.dtype != torch.float32 or tensor.device.type != "cpu" or not tensor.is_contiguous():
        raise InputError("is changed in place.", field=name, hint="give contiguous float32 on the CPU")
