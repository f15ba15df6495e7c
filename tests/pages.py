"""What README and the pages of docs/ show, run as a reader would run it."""

import contextlib
import io
import re
from pathlib import Path

import jax

TOP = Path(__file__).parents[1]


def python_blocks(text: str) -> list[str]:
    """The Python code that a page shows."""
    return re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def printed_by(code: str, name: str, names: dict | None = None) -> str:
    """What code prints, run with JAX as a newcomer has it; what it defines is put into `names`."""
    printed = io.StringIO()
    standard = jax.numpy_dtype_promotion("standard")
    with standard, jax.numpy_rank_promotion("allow"), contextlib.redirect_stdout(printed):
        exec(compile(code, name, "exec"), {} if names is None else names)
    return printed.getvalue()
