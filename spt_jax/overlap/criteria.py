"""What the penalty's value may be: every overlap criterion, and all that is known of it."""

from collections.abc import Callable
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from spt_jax.overlap.measure import Measurement, Rule

Value = Literal["volume", "ratio"]


class Criterion(NamedTuple):
    """A number that says how much a mesh overlaps itself.

    Attributes:
        of: the number, of what was measured, with labels by the given rule.
        power: of a length, that it has as its unit: 3 of a volume. A value with a unit that is
            below the smallest normal number of the vertices' dtype is rounding, and comes back as
            zero without a slope.
        slope: its derivative by the vertices, where none of the kinds that `gradient=` names is to
            stand for it.
        on_device: whether `backend="xla"` has it, too (`xla/backend.py`).
    """

    of: Callable[[Measurement, Rule], float]
    power: int = 0
    slope: Callable[[Measurement], Float[np.ndarray, "V 3"]] | None = None
    on_device: bool = False


CRITERIA: dict[str, Criterion] = {
    "volume": Criterion(lambda found, rule: found.volume, power=3, on_device=True),
    # The paper's Eq. 11.
    "ratio": Criterion(lambda found, rule: np.mean(found.labels(rule) != 0), on_device=True),
}
assert tuple(CRITERIA) == get_args(Value)
