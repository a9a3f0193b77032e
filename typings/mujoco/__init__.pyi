# MuJoCo's names come from a C extension that pyright cannot read.
from typing import Any

def __getattr__(name: str) -> Any: ...
