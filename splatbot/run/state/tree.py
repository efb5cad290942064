"""Objects of the SLAM as a tree of JSON values and a list of arrays, and back."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel

from splatbot.config import Config
from splatbot.run.state.schema import (
    FORMAT_VERSION,
    TYPES,
    type_names,
    version_1_field,
    version_1_type,
    version_2_field,
)

Array = NDArray[Any]
Tree = Any

_SEQUENCES: dict[str, type] = {"list": list, "tuple": tuple, "set": set, "deque": deque}


class Encoder:
    """Turns objects into trees; the trees refer to ``arrays`` by index.

    An object or array that occurs twice is written once. Sections of the configuration are written by name only.
    Objects have the type and field names of :mod:`splatbot.run.state.schema`.

    Args:
        config: configuration whose sections are written by name.
        keep: takes the owner of an array and the array, and returns a tree if it stores the array itself. If it returns
            None, the array is appended to ``arrays``.
    """

    def __init__(self, config: Config, keep: Callable[[object, Array], Tree | None]) -> None:
        self.arrays: list[Array] = []
        self._sections = sections_of(config)
        self._config = config
        self._keep = keep
        self._known: dict[int, tuple[int, object]] = {}

    def encode(self, value: object) -> Tree:
        """Return the tree of a value.

        Raises:
            TypeError: The value holds an object, or an object has an attribute, that the schema does not list.
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
        self._known[id(value)] = (len(self._known), value)  # the reference keeps the id from being reused
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
        name = type_names().get(kind)
        if name is None:
            raise TypeError(f"{kind.__module__}:{kind.__qualname__} is not in splatbot/run/state/schema.py")
        saved, attributes = TYPES[name], vars(value)
        unlisted = attributes.keys() - set(saved.fields.values()) - saved.transient
        if unlisted:
            raise TypeError(f"splatbot/run/state/schema.py lists no field for {kind.__qualname__}.{min(unlisted)}")
        fields = {field: self.encode(attributes[attribute]) for field, attribute in saved.fields.items()}
        return {"$": "object", "type": name, "is": fields}

    def _section(self, value: BaseModel) -> Tree:
        if value is self._config or value == self._config:
            return {"$": "config", "is": ""}
        for name, section in self._sections.items():
            if value is section or value == section:
                return {"$": "config", "is": name}
        raise TypeError(f"{type(value).__name__} is not a section of this run's configuration")


def sections_of(config: Config) -> dict[str, Any]:
    """Return the sections of a configuration by name, and those that further cameras have of their own."""
    sections = {name: getattr(config, name) for name in type(config).model_fields}
    return sections | {f"cameras.{name}.tracking": config.of_camera(name).tracking for name in config.cameras}


class Decoder:
    """Turns trees of :class:`Encoder` back into objects.

    Args:
        config: configuration that holds the sections.
        arrays: by index.
        kept: returns the array for a tree that the encoder's ``keep`` returned.
        version: format version of the tree.
    """

    def __init__(
        self, config: Config, arrays: Sequence[Array], kept: Callable[[Tree], Array], version: int = FORMAT_VERSION
    ) -> None:
        self.unused: dict[str, dict[str, Any]] = {}
        """Fields of version 1 that this version does not have, by type."""
        self._config = config
        self._arrays = arrays
        self._kept = kept
        self._version = version
        self._known: list[Any] = []

    def decode(self, tree: Tree) -> Any:
        """Return the value of a tree.

        Raises:
            ValueError: An encoder did not write the tree, or a type or field is unknown or missing.
        """
        if not isinstance(tree, dict):
            return tree
        kind, inner = tree["$"], tree["is"]
        if kind == "float":
            return float(inner)
        if kind == "scalar":
            return np.dtype(tree["dtype"]).type(self.decode(inner))
        if kind == "config":
            return sections_of(self._config)[inner] if inner else self._config
        if kind == "again":
            return self._known[inner]
        index = len(self._known)
        self._known.append(None)
        return self._make(tree, kind, inner, index)

    def _make(self, tree: Tree, kind: str, inner: Any, index: int) -> Any:
        if kind == "object":
            return self._object_of_version_1(tree, index) if self._version == 1 else self._object(tree, index)
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
        self._known[index] = value
        return value

    def _object(self, tree: Tree, index: int) -> Any:
        name, inner = tree["type"], tree["is"]
        if name not in TYPES:
            raise ValueError(f"{name} is not a type of a saved run")
        if self._version == 2:
            inner = {version_2_field(name, field): item for field, item in inner.items()}
        saved = TYPES[name]
        different = (inner.keys() ^ saved.fields.keys()) - saved.added - saved.removed
        if different:
            raise ValueError(f"{name} has other fields: {', '.join(sorted(different))}")
        value = self._known[index] = self._blank(name)
        fields = {field: self.decode(item) for field, item in inner.items()}
        self._set(value, name, {field: item for field, item in fields.items() if field not in saved.removed})
        return value

    def _object_of_version_1(self, tree: Tree, index: int) -> Any:
        name = version_1_type(tree["class"])
        value = self._known[index] = self._blank(name) if name in TYPES else None
        fields = {version_1_field(name, attribute): self.decode(item) for attribute, item in tree["is"].items()}
        if name == "mapping_worker":
            value = self._known[index] = fields.pop("mapper")
        known = TYPES[name].fields if name in TYPES else {}
        self.unused.setdefault(name, {}).update({f: fields.pop(f) for f in [*fields] if f not in known})
        missing = known.keys() - fields.keys() - TYPES[name].added if known else set()
        if missing and TYPES[name].create is None:
            raise ValueError(f"{name} has no {min(missing)}")
        if known:
            self._set(value, name, fields)
        return value

    def _blank(self, name: str) -> Any:
        saved = TYPES[name]
        if saved.create is not None:
            return saved.create(self._config)
        value: Any = object.__new__(saved.cls)
        self._set(value, name, saved.defaults())
        return value

    @staticmethod
    def _set(value: Any, name: str, fields: Mapping[str, Any]) -> None:
        for field, item in fields.items():
            object.__setattr__(value, TYPES[name].fields[field], item)  # frozen dataclasses included
