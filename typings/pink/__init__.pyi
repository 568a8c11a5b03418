# An extra that need not be installed for type checking: every name is taken as it is.
from typing import Any

def __getattr__(name: str) -> Any: ...
