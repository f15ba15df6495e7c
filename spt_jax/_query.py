"""What every public function asks of its mesh and its rays, checked while tracing."""

from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Integer

from spt_jax._known import check_indices
from spt_jax.overlap.criteria import CRITERIA
from spt_jax.overlap.measure import Directions
from spt_jax.overlap.rays.beam import Rays, orthogonal_directions
from spt_jax.xla.settings import Xla

# A body at 4096 x 4096 rays takes 2 GB; four times that is more than most machines can spare.
MOST_RAYS = 4096


def as_mesh(vertices: Any, faces: Any) -> tuple[Float[Array, "*batch V 3"], Integer[Array, "F 3"]]:
    """The mesh as JAX arrays.

    Raises:
        TypeError, ValueError: as `as_vertices` and `as_faces`.
    """
    checked = as_vertices(vertices)
    return checked, jnp.asarray(as_faces(faces, checked.shape[-2]))


def as_vertices(vertices: Any) -> Float[Array, "*batch V 3"]:
    """Positions as a JAX array.

    Raises:
        TypeError: not floating point.
        ValueError: a shape that is not (..., V, 3).
    """
    given = getattr(vertices, "dtype", None)
    if given is None:
        vertices = np.asarray(vertices)
        given = vertices.dtype
    if given not in (np.float32, np.float64):
        raise TypeError(
            f"vertices must be float32 or float64: got {given}; convert them with "
            "vertices.astype(jnp.float32)."
        )
    shape = np.shape(vertices)
    if len(shape) < 2 or shape[-1] != 3:
        raise ValueError(
            f"vertices must have shape (..., V, 3): got {shape}; the last axis is x, y, z."
        )
    # Not jnp.asarray, which compiles a program for each shape.
    return vertices if isinstance(vertices, jax.Array) else jax.device_put(vertices)


def as_faces(faces: Any, num_vertices: int) -> Integer[Array | np.ndarray, "F 3"]:
    """Indices of corners: a NumPy array where their values are known.

    Raises:
        TypeError: not whole numbers.
        ValueError: a shape that is not (F, 3); an index out of range, where the values are known
            (inside `jit` with traced faces they are not, and such a mesh gives NaN).
    """
    given = getattr(faces, "dtype", None)
    if given is None:
        faces = np.asarray(faces)
        given = faces.dtype
    if not np.issubdtype(given, np.integer):
        raise TypeError(f"faces must be whole numbers: got {given}; use int32 indices.")
    shape = np.shape(faces)
    if len(shape) != 2 or shape[-1] != 3:
        raise ValueError(
            f"faces must have shape (F, 3): got {shape}; split other polygons into "
            "triangles, and batch meshes of different faces with jax.vmap."
        )
    if isinstance(faces, Tracer):
        return faces
    known = np.asarray(faces)
    check_indices(known, num_vertices)
    return known


def as_rays(rays: Any) -> Rays:
    """None (exact), a whole number of rays along the longer side, or (rows, columns).

    Raises:
        TypeError, ValueError: anything else, or a number out of 1 to 4096.
    """
    if rays is None:
        return None
    if isinstance(rays, (tuple, list)) and len(rays) == 2:
        return _as_count(rays[0], rays), _as_count(rays[1], rays)
    return _as_count(rays, rays)


def _as_count(side: Any, rays: Any) -> int:
    if not isinstance(side, (int, np.integer)) or isinstance(side, bool):
        raise TypeError(f"rays must be None, a whole number or (rows, columns): got {rays!r}.")
    if side < 1 or side > MOST_RAYS:
        raise ValueError(
            f"rays must be from 1 to {MOST_RAYS} a side: got {rays!r}; 512 is a good start."
        )
    return int(side)


def as_directions(directions: Any) -> Directions:
    """One or three orthogonal directions, or the rows of a D x 3 array, as unit vectors.

    Raises:
        TypeError: traced directions, or something that is no array of numbers.
        ValueError: another count than 1 or 3; another shape than (D, 3) with D > 0; a direction
            that is zero or not finite.
    """
    if isinstance(directions, Tracer):
        raise TypeError(
            "directions must be known when traced: got a traced array; pass 1, 3 or a NumPy array."
        )
    if isinstance(directions, (int, np.integer)) and not isinstance(directions, bool):
        if directions not in (1, 3):
            raise ValueError(
                f"directions must be 1, 3 or an array of shape (D, 3): got {directions}; pass the "
                "directions themselves for another count."
            )
        return orthogonal_directions(int(directions))
    try:
        rows = np.asarray(directions, dtype=np.float64)
    except (TypeError, ValueError):
        raise TypeError(
            f"directions must be 1, 3 or an array of shape (D, 3): got {directions!r}."
        ) from None
    if rows.ndim != 2 or rows.shape[1] != 3 or len(rows) == 0:
        raise ValueError(
            f"directions must be 1, 3 or an array of shape (D, 3): got shape {rows.shape}; give "
            "one direction as [[x, y, z]]."
        )
    for k, row in enumerate(rows):
        if not np.isfinite(row).all() or not np.abs(row).max() > 0:
            raise ValueError(
                f"directions must be finite and not zero: got {row.tolist()} in row {k}; lengths "
                "do not matter, they are normalized."
            )
    # Scaling by the largest component first keeps tiny and huge vectors from under- or overflowing.
    rows = rows / np.abs(rows).max(axis=1, keepdims=True)
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return tuple((float(x), float(y), float(z)) for x, y, z in rows)


def as_choice(name: str, value: Any, choices: Any) -> Any:
    """The value itself, one of the Literal type's own.

    Raises:
        ValueError: any other value.
    """
    allowed = get_args(choices)
    if not isinstance(value, str) or value not in allowed:
        listed = ", ".join(repr(choice) for choice in allowed)
        raise ValueError(f"{name} must be one of {listed}: got {value!r}.")
    return value


def as_criterion(value: Any, on_device: bool) -> str:
    """The name of an overlap criterion.

    Raises:
        ValueError: any other value, or one that the device path does not have and is to.
    """
    names = [name for name, found in CRITERIA.items() if found.on_device or not on_device]
    if not isinstance(value, str) or value not in names:
        where = ' with backend="xla"' if on_device else ""
        listed = ", ".join(map(repr, names))
        raise ValueError(f"value must be one of {listed}{where}: got {value!r}.")
    return value


def as_margin(margin: Any) -> float:
    """A distance to keep between sheets.

    Raises:
        TypeError, ValueError: no number, traced, negative or not finite.
    """
    if isinstance(margin, bool) or not isinstance(margin, (int, float, np.integer, np.floating)):
        raise TypeError(
            f"margin must be a number known when traced: got {margin!r}; pass a float, in the "
            "vertices' unit."
        )
    if not 0 <= margin < np.inf:
        raise ValueError(
            f"margin must be finite and not negative: got {margin!r}; 0 measures the surface as "
            "it is."
        )
    return float(margin)


Backend = Literal["auto", "numpy", "xla"]


def as_backend(backend: Any) -> Xla | None:
    """The settings of the device path; None for the host's, which "auto" means everywhere.

    On GPUs and TPUs too: the host path measures in closed form, the device path samples, and nobody
    has run it on an accelerator yet, so it has to be asked for. What goes to the host and back is
    little: of the embedded body 150 kB of vertices, 300 kB of faces and 150 kB of gradient.

    Raises:
        ValueError: an unknown name.
    """
    if isinstance(backend, Xla):
        return backend
    as_choice("backend", backend, Backend)
    return Xla() if backend == "xla" else None
