"""Objects of the SLAM as a tree of JSON values and a list of arrays, and back."""

from __future__ import annotations

import importlib
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel

from splatbot.config import Config

Array = NDArray[Any]
Tree = Any

# Only classes of these modules are made when a state is read, and none of their code runs but __setstate__.
_MODULES = (
    "splatbot.camera",
    "splatbot.frame",
    "splatbot.gaussians.",
    "splatbot.mapping.",
    "splatbot.optimize.",
    "splatbot.slam",
    "splatbot.tracking.",
)


class Encoder:
    """Turns objects into trees; ``arrays`` collects what the trees refer to by number.

    An object or array that is met twice is written once. Sections of the configuration are named, not written.

    Args:
        config: whose sections are named.
        keep: takes an array that never changes in place and the object that owns it, and returns a tree for it, or None
            to have it collected like the others.
    """

    def __init__(self, config: Config, keep: Callable[[object, Array], Tree | None]) -> None:
        self.arrays: list[Array] = []
        self._sections = [(name, getattr(config, name)) for name in type(config).model_fields]
        self._config = config
        self._keep = keep
        self._known: dict[int, tuple[int, object]] = {}

    def encode(self, value: object) -> Tree:
        """The tree of a value.

        Raises:
            TypeError: it holds something that cannot be saved.
        """
        if value is None or isinstance(value, bool | int | str):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else {"$": "float", "is": repr(value)}
        if isinstance(value, np.generic):
            return {"$": "scalar", "dtype": value.dtype.str, "is": self.encode(value.item())}
        if isinstance(value, BaseModel):
            return self._section(value)
        if id(value) in self._known:
            return {"$": "again", "is": self._known[id(value)][0]}
        self._known[id(value)] = (len(self._known), value)  # holding it keeps its id its own
        return self._container(value)

    def _container(self, value: Any) -> Tree:
        if isinstance(value, np.ndarray | torch.Tensor):
            return self._array(value)
        if isinstance(value, list | tuple | set | deque) and type(value) in _SEQUENCES.values():
            return {"$": type(value).__name__, "is": [self.encode(item) for item in value]}
        if isinstance(value, dict | WeakKeyDictionary):
            kind = "dict" if isinstance(value, dict) else "weak"
            return {"$": kind, "is": [[self.encode(k), self.encode(v)] for k, v in value.items()]}
        if isinstance(value, np.random.Generator):
            return {"$": "random", "is": self.encode(value.bit_generator.state)}
        return self._object(value)

    def _array(self, value: Array | torch.Tensor) -> Tree:
        tensor = isinstance(value, torch.Tensor)
        array = value.detach().numpy() if isinstance(value, torch.Tensor) else value
        if array.dtype.hasobject:
            raise TypeError("an array of objects cannot be saved")
        kept = self._keep(value, array)
        if kept is None:
            kept = len(self.arrays)
            self.arrays.append(array)
        return {"$": "tensor" if tensor else "array", "is": kept}

    def _object(self, value: object) -> Tree:
        kind = type(value)
        name = f"{kind.__module__}:{kind.__qualname__}"
        if not kind.__module__.startswith(_MODULES):
            raise TypeError(f"{name} cannot be saved; give its owner a __getstate__ that leaves it out")
        own = kind.__dict__.get("__getstate__")
        state = own(value) if own is not None else vars(value)
        return {"$": "object", "class": name, "is": {key: self.encode(item) for key, item in state.items()}}

    def _section(self, value: BaseModel) -> Tree:
        if value is self._config or value == self._config:
            return {"$": "config", "is": ""}
        for name, section in self._sections:
            if value is section or value == section:
                return {"$": "config", "is": name}
        raise TypeError(f"{type(value).__name__} is no part of the configuration in force")


class Decoder:
    """Turns trees of :class:`Encoder` back into objects.

    Args:
        config: what sections are taken from.
        arrays: by number.
        kept: gives the arrays that the encoder's ``keep`` took care of.
    """

    def __init__(self, config: Config, arrays: Sequence[Array], kept: Callable[[Tree], Array]) -> None:
        self._config = config
        self._arrays = arrays
        self._kept = kept
        self._known: list[Any] = []

    def decode(self, tree: Tree) -> Any:
        """The value of a tree.

        Raises:
            ValueError: the tree is none of an encoder's, or names a class or a field that there is not.
        """
        if not isinstance(tree, dict):
            return tree
        kind, inner = tree["$"], tree["is"]
        if kind == "float":
            return float(inner)
        if kind == "scalar":
            return np.dtype(tree["dtype"]).type(self.decode(inner))
        if kind == "config":
            return getattr(self._config, inner) if inner else self._config
        if kind == "again":
            return self._known[inner]
        place = len(self._known)
        self._known.append(None)
        return self._make(tree, kind, inner, place)

    def _make(self, tree: Tree, kind: str, inner: Any, place: int) -> Any:
        if kind == "object":
            return self._object(tree["class"], inner, place)
        if kind in ("array", "tensor"):
            array = self._arrays[inner] if isinstance(inner, int) else self._kept(inner)
            value: Any = torch.from_numpy(array) if kind == "tensor" else array
        elif kind in _SEQUENCES:
            value = _SEQUENCES[kind](self.decode(item) for item in inner)
        elif kind == "dict":
            value = {self.decode(k): self.decode(v) for k, v in inner}
        elif kind == "weak":
            value = WeakKeyDictionary({self.decode(k): self.decode(v) for k, v in inner})
        elif kind == "random":
            value = np.random.default_rng()
            value.bit_generator.state = self.decode(inner)
        else:
            raise ValueError(f"unknown kind {kind!r}")
        self._known[place] = value
        return value

    def _object(self, name: str, inner: dict[str, Tree], place: int) -> Any:
        kind = _class_of(name)
        value: Any = object.__new__(kind)
        self._known[place] = value
        state = {key: self.decode(item) for key, item in inner.items()}
        if "__setstate__" in kind.__dict__:
            value.__setstate__(state)
            return value
        if is_dataclass(kind) and {f.name for f in fields(kind)} - set(state):
            raise ValueError(f"{name} has other fields than those saved")
        for key, item in state.items():
            object.__setattr__(value, key, item)  # frozen dataclasses included
        return value


_SEQUENCES: dict[str, type] = {"list": list, "tuple": tuple, "set": set, "deque": deque}


def _class_of(name: str) -> type:
    module, _, qualname = name.partition(":")
    if not module.startswith(_MODULES) or "." in qualname:
        raise ValueError(f"{name} is no class that a state may hold")
    try:
        kind = getattr(importlib.import_module(module), qualname)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"there is no {name}") from error
    if not isinstance(kind, type) or kind.__module__ != module:
        raise ValueError(f"{name} is no class of its module")
    return kind
