"""What benchmarks compare the C++ core with; its own docstrings say what there is (splatbot/native/bench)."""

from typing import Any

def __getattr__(name: str) -> Any: ...
