# Compiled from src/; bind_*.cpp say what there is.
from typing import Any

def __getattr__(name: str) -> Any: ...
