"""RRT-Connect and shortcuts with collision checks at discrete configurations, as in most motion planning stacks."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array

Free = Callable[[Array], NDArray[np.bool_]]  # configurations (C, J) -> free (C,)


@dataclass(frozen=True)
class DiscreteConstants:
    """Constants of the planner that checks discrete configurations.

    Args:
        resolution: [rad] distance between the checked configurations of an edge.
        step: [rad] extension of a tree.
        cuts: shortcut attempts.
    """

    resolution: float = 1 / 32
    step: float = 0.6
    cuts: int = 40


CONSTANTS = DiscreteConstants()


def edge_free(free: Free, a: Array, b: Array) -> bool:
    """Return whether the configurations on the straight edge between two (J,) are free, ``b`` included."""
    count = max(1, int(np.ceil(np.linalg.norm(b - a) / CONSTANTS.resolution)))
    shares = np.arange(1, count + 1) / count
    return bool(free(a + shares[:, None] * (b - a)).all())


def connect(free: Free, lower: Array, upper: Array, start: Array, goal: Array, *, seconds: float, seed: int) -> Array:
    """Plan a shortcut path by RRT-Connect (Kuffner and LaValle 2000): waypoints (N, J), N = 0 without a path in time.

    Args:
        free: returns which configurations are free.
        lower, upper: (J,) joint limits.
        start, goal: (J,), both free.
        seconds: time limit [s] of the first path.
        seed: of the samples.
    """
    until = time.perf_counter() + seconds
    rng = np.random.default_rng(seed)
    trees = _Tree(start), _Tree(goal)
    if edge_free(free, start, goal):
        return np.stack([start, goal])
    while time.perf_counter() < until:
        here, there = trees
        grown = here.extend(free, rng.uniform(lower, upper))
        if grown is not None:
            met = there.reach(free, here.nodes[grown], until)
            if met is not None:
                path = np.concatenate([here.to_root(grown)[::-1], there.to_root(met)[1:]])
                path = path if np.array_equal(path[0], start) else path[::-1]
                return shortened(free, path, rng)
        trees = there, here
    return np.zeros((0, len(start)))


def shortened(free: Free, path: Array, rng: np.random.Generator) -> Array:
    """Shorten a path (N, J) by straight connections between two random positions on it."""
    for _ in range(CONSTANTS.cuts):
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        low, high = np.sort(rng.uniform(0.0, along[-1], 2))
        a, b = (np.array([np.interp(s, along, column) for column in path.T]) for s in (low, high))
        if edge_free(free, a, b):
            path = np.concatenate([path[along < low], a[None], b[None], path[along > high]])
    return path


class _Tree:
    def __init__(self, root: Array) -> None:
        self.nodes, self.parents = [root], [-1]

    def extend(self, free: Free, to: Array) -> int | None:
        """Extend the tree by one step towards a configuration; return the new node, or None if it is not free."""
        nearest = int(np.argmin(np.linalg.norm(np.array(self.nodes) - to, axis=1)))
        direction = to - self.nodes[nearest]
        length = float(np.linalg.norm(direction))
        end = self.nodes[nearest] + direction * min(1.0, CONSTANTS.step / max(length, 1e-12))
        if length < 1e-9 or not edge_free(free, self.nodes[nearest], end):
            return None
        self.nodes.append(end)
        self.parents.append(nearest)
        return len(self.nodes) - 1

    def reach(self, free: Free, to: Array, until: float) -> int | None:
        """Extend the tree until it reaches a configuration; return its node, or None if an obstacle is in between."""
        while time.perf_counter() < until:
            node = self.extend(free, to)
            if node is None:
                return None
            if np.linalg.norm(self.nodes[node] - to) < 1e-9:
                return node
        return None

    def to_root(self, node: int) -> Array:
        found = []
        while node >= 0:
            found.append(self.nodes[node])
            node = self.parents[node]
        return np.array(found)
