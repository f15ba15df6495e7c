"""Our docstrings in the words that the reader of Google's style knows."""

import re
from typing import Any

import griffe


class HouseStyle(griffe.Extension):
    """Rewrites each docstring before it is parsed; what a reader of the code sees stays.

    `Example:` becomes a section of doctests, `Differentiation:` a paragraph with its name in bold,
    and arguments that share a description get it one by one.
    """

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrite one docstring."""
        if obj.docstring is not None:
            obj.docstring.value = rewritten(obj.docstring.value)


def rewritten(text: str) -> str:
    """A docstring with the headings and entries of Google's style."""
    text = re.sub(r"^Example:$", "Examples:", text, flags=re.MULTILINE)
    text = re.sub(
        r"^Differentiation: (.*(?:\n +.*)*)",
        lambda found: "**Differentiation:** " + re.sub(r"\n +", "\n", found[1]),
        text,
        flags=re.MULTILINE,
    )
    # "a, b: text" and the lines that go on below it.
    entry = r"^    (\w+(?:, \w+)+): (.*(?:\n {8,}.*)*)"
    return re.sub(
        r"^(Args|Attributes):\n((?:(?: {4}.*)?\n)*(?: {4}.*)?)",
        lambda part: f"{part[1]}:\n" + re.sub(entry, _one_by_one, part[2], flags=re.MULTILINE),
        text,
        flags=re.MULTILINE,
    )


def _one_by_one(found: re.Match) -> str:
    return "\n".join(f"    {name}: {found[2]}" for name in found[1].split(", "))
