# mujoco ships no type stubs, and its names are compiled: all of them are Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
