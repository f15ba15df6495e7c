"""What keeps a fitted body from passing through itself, one module each, found by its name.

A module of this folder without an underscore is a regularizer's: it holds a class derived from
`Regularizer` whose `name` is the module's. Functions, messages and the command line list the
folder, so that a new one is a new file and nothing else.
"""

import importlib
import pkgutil
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spt_jax.fit.regularizers._base import Regularizer


@cache
def regularizer_names() -> tuple[str, ...]:
    """The regularizers that are known by a name; none is imported for that.

    Example:
        >>> from spt_jax.fit.regularizers import regularizer_names
        >>> regularizer_names()
        ('laplacian', 'none', 'spheres', 'spt')
    """
    found = (module.name for module in pkgutil.iter_modules(__path__))
    return tuple(sorted(name for name in found if not name.startswith("_")))


def as_regularizer(regularizer: "str | Regularizer") -> "Regularizer":
    """A regularizer, or the one of a name with its usual weights.

    Raises:
        ValueError: an unknown name.
        TypeError: neither a name nor a `Regularizer`.

    Example:
        >>> from spt_jax.fit.regularizers import as_regularizer
        >>> type(as_regularizer("spt")).__name__
        'SelfIntersection'
    """
    from spt_jax.fit.regularizers._base import Regularizer

    if isinstance(regularizer, Regularizer):
        return regularizer
    if isinstance(regularizer, str) and regularizer in regularizer_names():
        module = importlib.import_module(f"{__name__}.{regularizer}")
        return next(kind for kind in vars(module).values() if _is_named(kind, regularizer))()
    listed = ", ".join(repr(name) for name in regularizer_names())
    kind = ValueError if isinstance(regularizer, str) else TypeError
    raise kind(f"regularizer must be one of {listed}, or a Regularizer: got {regularizer!r}.")


def _is_named(kind: Any, name: str) -> bool:
    return isinstance(kind, type) and getattr(kind, "name", None) == name
