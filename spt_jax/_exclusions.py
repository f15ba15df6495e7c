"""The arguments that say which overlaps are excluded: groups of faces, and a rest surface."""

from typing import Any

import numpy as np
from jax.core import Tracer

from spt_jax.overlap.exclusions import Exclusions
from spt_jax.rest.surface import RestSurface


def as_exclusions(
    face_groups: Any, ignore_groups: Any, rest_surface: Any, faces: Any
) -> Exclusions:
    """Which overlaps are excluded, as a hashable object.

    Raises:
        TypeError: traced groups; groups that are not whole numbers; a rest_surface of another type.
        ValueError: groups or a rest surface of other faces; pairs that are not pairs of groups.
    """
    num_faces: int = np.shape(faces)[0]
    if rest_surface is not None and not isinstance(rest_surface, RestSurface):
        raise TypeError(
            f"rest_surface must be a RestSurface or None: got {type(rest_surface).__name__}; pass "
            "body.rest_surface, or RestSurface(rest_vertices, faces)."
        )
    if rest_surface is not None and rest_surface.num_faces != num_faces:
        raise ValueError(
            f"rest_surface must have these faces: got one of {rest_surface.num_faces} faces for "
            f"{num_faces}; for several bodies in one mesh pass rest_surface.copies(count)."
        )
    known = not isinstance(faces, Tracer)
    if rest_surface is not None and known and not rest_surface.has_faces(faces):
        raise ValueError(
            "rest_surface must have these faces: got as many other faces; make it from the faces "
            "that you pass, RestSurface(rest_vertices, faces)."
        )
    pairs = _as_pairs(ignore_groups)
    if face_groups is None:
        if pairs:
            raise ValueError(
                f"ignore_groups must come with face_groups: got {ignore_groups!r} alone; pass the "
                "group of each triangle, such as body.part_groups."
            )
        return Exclusions(rest=rest_surface)
    if isinstance(face_groups, Tracer):
        raise TypeError(
            "face_groups must be known when traced: got a traced array; pass a NumPy array."
        )
    groups = np.asarray(face_groups)
    if not np.issubdtype(groups.dtype, np.integer):
        raise TypeError(f"face_groups must be whole numbers: got {groups.dtype}; use int32.")
    if groups.shape != (num_faces,):
        raise ValueError(
            f"face_groups must have one number a face, ({num_faces},): got shape {groups.shape}."
        )
    present = set(np.unique(groups).tolist())
    for pair in pairs:
        missing = [group for group in pair if group not in present]
        if missing:
            raise ValueError(
                f"ignore_groups must name groups of face_groups: got {pair}, and no face is in "
                f"group {missing[0]}."
            )
    if not pairs:
        return Exclusions(rest=rest_surface)
    return Exclusions(groups.astype(np.int64).tobytes(), pairs, rest_surface)


def as_fold_surface(body: Any, fold_distance: Any) -> RestSurface:
    """The rest surface that decides what folds: the body's own, or with one distance everywhere.

    Args:
        body: a `BodyModel`, or another with a `rest_surface`.
        fold_distance: in metres; None for the body's own distances, place by place.

    Raises:
        TypeError, ValueError: a distance that is no number, negative or not finite.
    """
    distance = as_fold_distance(fold_distance)
    return body.rest_surface if distance is None else body.rest_surface.within(distance)


def as_fold_distance(fold_distance: Any) -> float | None:
    """A distance along the rest surface, or None.

    Raises:
        TypeError, ValueError: no number, negative or not finite.
    """
    if fold_distance is None:
        return None
    if isinstance(fold_distance, bool) or not isinstance(
        fold_distance, (int, float, np.integer, np.floating)
    ):
        raise TypeError(
            f"fold_distance must be a number of metres or None: got {fold_distance!r}; 0.3 suits "
            "trunk and limbs."
        )
    if not 0 <= fold_distance < np.inf:
        raise ValueError(
            f"fold_distance must be finite and not negative: got {fold_distance!r}; 0.3 m suits "
            "trunk and limbs."
        )
    return float(fold_distance)


def _as_pairs(ignore_groups: Any) -> tuple[tuple[int, int], ...]:
    try:
        pairs: np.ndarray = np.asarray(
            ignore_groups if len(ignore_groups) else np.zeros((0, 2), int)
        )
    except (TypeError, ValueError):
        pairs = np.zeros(0)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not np.issubdtype(pairs.dtype, np.integer):
        raise ValueError(
            f"ignore_groups must be pairs of group numbers, ((a, b), ...): got {ignore_groups!r}."
        )
    return tuple(sorted({(min(a, b), max(a, b)) for a, b in pairs.tolist()}))
