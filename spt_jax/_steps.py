"""Steps of a search, as `on_step` gets them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Step:
    """Where a search has come to.

    Volume and pairs are measured when they are first read, so a callback that only counts steps
    costs nothing.

    Attributes:
        stage: the weight of `untangle_pose`, or the attempt of `untangle_mesh`, counted from 0.
        steps: how many steps were taken, over all stages.
        vertices: the surface at this step, in the unit given.
        pose: the pose at this step, in radians; None for a mesh.

    Example:
        >>> import trimesh
        >>> from spt_jax import untangle_mesh
        >>> ball = trimesh.creation.icosphere(subdivisions=2)
        >>> pair = trimesh.util.concatenate(ball, ball.copy().apply_translation([1.8, 0.1, 0.2]))
        >>> seen = []
        >>> found = untangle_mesh(pair.vertices, pair.faces, on_step=seen.append)
        >>> seen[0].intersecting_pairs > 0, seen[-1].intersecting_pairs, seen[-1].volume
        (True, 0, 0.0)
    """

    stage: int
    steps: int
    vertices: Float[np.ndarray, "V 3"]
    pose: Float[np.ndarray, "J 3"] | None = None
    _measure: Callable[[], tuple[float, int]] = field(default=lambda: (np.nan, -1), repr=False)

    @cached_property
    def _measured(self) -> tuple[float, int]:
        return self._measure()

    @property
    def volume(self) -> float:
        """The included overlap volume, in the cube of the unit; NaN if it cannot be measured."""
        return self._measured[0]

    @property
    def intersecting_pairs(self) -> int:
        """The number of face pairs that intersect and count; -1 if they cannot be measured."""
        return self._measured[1]


OnStep = Callable[[Step], None]


def no_step(step: Step) -> None:
    """Do nothing at a step."""
