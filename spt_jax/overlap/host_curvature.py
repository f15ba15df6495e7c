"""What JAX asks the host for where second derivatives are wanted; as `host_functions.py`.

A gradient that is asked for to second order leaves what it measured behind, for the products with
the Hessian that follow.
"""

import os
import threading
from collections import OrderedDict

import numpy as np
from jaxtyping import Float

from spt_jax.overlap.host_functions import Faces, PenaltyOptions, Vertices, measured
from spt_jax.overlap.measure import Measurement

# How many meshes are kept for products with their Hessian: a body's take 10 MB, measuring it again
# takes 12 ms or more, a product 0.5.
_MOST_KEPT = 8


def kept_on_host(
    vertices: Vertices, faces: Faces, options: PenaltyOptions
) -> tuple[Float[np.ndarray, ""], Float[np.ndarray, "V 3"]]:
    """The penalty and its gradient, of which what was measured is kept."""
    value, gradient, found = measured(vertices, faces, options, with_gradient=True)
    curvatures.keep(vertices, faces, options, found)
    return value, gradient


def curvature_on_host(
    both: Float[np.ndarray, "W 3"], faces: Faces, options: PenaltyOptions
) -> tuple[Float[np.ndarray, "V 3"]]:
    """The Hessian of one mesh times a velocity of its vertices.

    Args:
        both: the vertices, and after them as many rows of the velocity.
        faces: of the mesh.
        options: what is asked.
    """
    vertices, velocity = np.split(both, 2)
    found = curvatures.of(vertices, faces, options)
    if found is None:
        return (np.zeros_like(velocity),)
    if not found.exact:  # sampled by rays: there is nothing to derive
        return (np.full_like(velocity, np.nan),)
    product = found.curvature.times(velocity)
    finite = np.isfinite(velocity).all()
    # In float32, more than it can hold is no number of its own.
    narrow = options.rounding > np.finfo(np.float64).eps
    most = np.finfo(np.float32 if narrow else np.float64).max
    if finite and not (np.abs(product) <= most).all():
        return (np.full_like(velocity, np.nan),)
    return (product,)


class Curvatures:
    """A bounded memory of what was measured last, for any number of threads."""

    def __init__(self, most: int = _MOST_KEPT):
        self._most = most
        self.begin_anew()

    def begin_anew(self) -> None:
        """Forget all, with a lock of its own: a forked child inherits one that may be held."""
        self._lock = threading.Lock()
        self._kept: OrderedDict[tuple, tuple[np.ndarray, Measurement | None]] = OrderedDict()

    def clear(self) -> None:
        """Forget all."""
        with self._lock:
            self._kept.clear()

    def __len__(self) -> int:
        return len(self._kept)

    def keep(self, vertices, faces, options: PenaltyOptions, found: Measurement | None) -> None:
        """Remember what was measured; None: there is no overlap."""
        key = (vertices.tobytes(), id(faces), options)
        with self._lock:
            # With the faces themselves, so that their id is not lent to others.
            self._kept[key] = faces, found
            self._kept.move_to_end(key)
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)

    def of(self, vertices, faces, options: PenaltyOptions) -> Measurement | None:
        """What was measured of a mesh, or is now."""
        key = (vertices.tobytes(), id(faces), options)
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key][1]
        _, _, found = measured(vertices, faces, options, with_gradient=True)
        self.keep(vertices, faces, options, found)
        return found


curvatures = Curvatures()

if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=curvatures.begin_anew)
