"""The C++ core; its own docstrings say what there is (splatbot/native/bindings)."""

from typing import Any

def __getattr__(name: str) -> Any: ...
