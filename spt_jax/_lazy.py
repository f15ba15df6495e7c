"""Names of a package that are imported when they are first asked for."""

import importlib
import sys
from collections.abc import Callable
from typing import Any


def lazy_names(
    package: str, names: dict[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package (PEP 562).

    Args:
        package: its name.
        names: each name, and the module that has it; a name that is itself a module comes with "".
    """

    def __getattr__(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = importlib.import_module(names[name] or f"{package}.{name}")
        found = getattr(module, name) if names[name] else module
        setattr(sys.modules[package], name, found)
        return found

    def __dir__() -> list[str]:
        known = {name for name, module in names.items() if module}
        return sorted({*vars(sys.modules[package]), *known})

    return __getattr__, __dir__
