"""The arguments of rest surfaces, checked; NumPy alone, because workers unpickle rest surfaces."""

from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from spt_jax._known import check_indices, is_traced

# The different distances, ascending, and which of them each face has (a byte for each; none where
# there is one distance): what is compared and hashed.
Levels: TypeAlias = tuple[tuple[float, ...], bytes]

# Distances of many faces are rounded down to so many steps of one ratio.
_MOST_LEVELS = 32


def as_surface(
    rest_vertices: Any, faces: Any
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """The mesh at rest, in float64 and int64.

    Raises:
        TypeError, ValueError: as `RestSurface`.
    """
    for name, given in (("rest_vertices", rest_vertices), ("faces", faces)):
        if is_traced(given):
            raise TypeError(
                f"{name} must be known when traced: got a traced array; make the RestSurface (or "
                "take body.rest_surface) outside jit, grad and vmap, and pass it in as an option."
            )
    vertices, corners = np.asarray(rest_vertices), np.asarray(faces)
    if not np.issubdtype(vertices.dtype, np.floating):
        raise TypeError(
            f"rest_vertices must be floating-point: got {vertices.dtype}; convert them with "
            "rest_vertices.astype('float32')."
        )
    if not np.issubdtype(corners.dtype, np.integer):
        raise TypeError(f"faces must be whole numbers: got {corners.dtype}; use int32 indices.")
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(
            f"rest_vertices must have shape (V, 3): got {vertices.shape}; a batch shares one rest "
            "mesh."
        )
    if corners.ndim != 2 or corners.shape[1] != 3:
        raise ValueError(f"faces must have shape (F, 3): got {corners.shape}; use triangles.")
    if not np.isfinite(vertices).all():
        row = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise ValueError(
            f"rest_vertices must be finite: got {vertices[row].tolist()} in row {row}; drop or "
            "repair such vertices."
        )
    check_indices(corners, len(vertices))
    return vertices.astype(np.float64), corners.astype(np.int64)


def as_distances(distance: Any, count: int) -> Levels:
    """The distances of `count` faces.

    Raises:
        TypeError, ValueError: as `RestSurface`.
    """
    if np.ndim(distance) == 0:
        return (as_number("distance", distance, "0.3 m suits a body"),), b""
    if is_traced(distance):
        raise TypeError("distance must be known when traced: got a traced array; use NumPy.")
    given = np.asarray(distance)
    if given.dtype.kind not in "fiu" or given.shape != (count,):
        raise ValueError(
            f"distance must be a number or one for each of the {count} faces: got an array of "
            f"{given.dtype} of shape {given.shape}."
        )
    given = given.astype(np.float64)
    wrong = np.flatnonzero(~((given >= 0) & (given < np.inf)))
    if len(wrong):
        raise ValueError(
            f"distance must be finite and not negative: got {given[wrong[0]]!r} for face "
            f"{wrong[0]}; 0.3 m suits a body."
        )
    levels = np.unique(given)
    if len(levels) > _MOST_LEVELS:
        low = max(levels[levels > 0].min(), 1e-6 * levels[-1])
        steps = np.geomspace(low, levels[-1], _MOST_LEVELS - 1)
        levels = np.append(0.0, steps)
        levels[-1] = given.max()
    level = np.searchsorted(levels, given, side="right") - 1
    used, level = np.unique(level, return_inverse=True)
    kept = tuple(levels[used].tolist()) or (0.0,)
    return kept, level.astype(np.uint8).tobytes() if len(kept) > 1 else b""


def as_number(name: str, value: Any, advice: str) -> float:
    """A finite number that is not negative.

    Raises:
        TypeError, ValueError: it is none; the message ends with the advice.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name} must be a number: got {value!r}; pass a float, and {advice}.")
    if not 0 <= value < np.inf:
        raise ValueError(f"{name} must be finite and not negative: got {value!r}; {advice}.")
    return float(value)
