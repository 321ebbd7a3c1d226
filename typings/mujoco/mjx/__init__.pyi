# MuJoCo's bindings are compiled and come without stubs: everything in them is of unknown type.
from typing import Any

def __getattr__(name: str) -> Any: ...
