"""The keypoints and starts of people, checked and brought to one form."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from spt_jax.body import BodyModel
from spt_jax.fit.problem.variables import Variables
from spt_jax.keypoints import AnyLayout
from spt_jax.keypoints import Person as SeenPerson
from spt_jax.keypoints.layouts import layouts_of_count

#: Keypoints as users have them: pixels, or people with a layout and confidences of their own.
Keypoints: TypeAlias = ArrayLike | Sequence[Any] | SeenPerson | Sequence[SeenPerson]

# A keypoint is expected to be found within this share of the box around a person's keypoints: 5
# pixels of a person who is 500 pixels tall.
_EXPECTED_SHARE = 0.01


class Person(eqx.Module):
    """What is known of one person; with a leading axis, of several."""

    keypoints: Float[Array, "*people K 2"]
    confidence: Float[Array, "*people K"]
    pixels: Float[Array, "*people"]  # expected error of a keypoint
    robust: Float[Array, "*people"] | None  # Geman-McClure's scale, in units of the expected error
    start: Variables


def as_seen_points(
    keypoints: Keypoints, confidence: Any, layout: AnyLayout | None
) -> tuple[Any, Any, AnyLayout]:
    """Points, confidences and layout of a call, apart.

    Raises:
        ValueError: people with confidences or layouts of their own who come with others, or whose
            layouts differ; pixels without a layout.
    """
    people = [keypoints] if isinstance(keypoints, SeenPerson) else keypoints
    if not (isinstance(people, (list, tuple)) and people and isinstance(people[0], SeenPerson)):
        if layout is None:
            count = count_points(keypoints)
            known = [f'"{name}"' for name in layouts_of_count(count)]
            raise ValueError(
                f"layout must say what the {count} keypoints are: got none; "
                + (f"{' or '.join(known)} has so many." if known else "give a list of names.")
            )
        return keypoints, confidence, layout
    if any(not isinstance(one, SeenPerson) for one in people):
        raise TypeError("keypoints must all be of one kind: got people and others in one list.")
    layouts = sorted({one.layout for one in people})
    if len(layouts) > 1:
        raise ValueError(
            f"keypoints must be of people with one layout: got {', '.join(layouts)}; fit the "
            "people of each layout in a call of their own."
        )
    if confidence is not None or layout not in (None, layouts[0]):
        raise ValueError(
            "confidence and layout must be left out where keypoints are people of read_keypoints: "
            f"they have their own, of layout {layouts[0]}."
        )
    if isinstance(keypoints, SeenPerson):
        return keypoints.points, keypoints.confidence, layouts[0]
    return [one.points for one in people], [one.confidence for one in people], layouts[0]


def as_people(
    body: BodyModel,
    keypoints: Any,
    confidence: Any,
    start: tuple[Any, Any, Any],
    expected_error: Any,
    robust: Any,
    *,
    placed: tuple[bool, ...] | None = None,
) -> tuple[Person, tuple[int, ...]]:
    """All people of a call, in one leading axis, and the batch axes that they came with.

    Args:
        body: the model.
        keypoints: (..., K, 2), or a list of (K, 2).
        confidence: (..., K), a list of (K,), or None.
        start: pose; shape and translation as the user gave them, or None.
        expected_error: in pixels, one or one a person, or None for a share of the person's size.
        robust: Geman-McClure's scale in pixels, one or one a person, or None.
        placed: whether each keypoint lies anywhere on the body; the others are treated as unseen.

    Raises:
        TypeError, ValueError: as `fit_pose`.
    """
    points = _stacked("keypoints", keypoints)
    if points.ndim < 2 or points.shape[-1] != 2:
        raise ValueError(
            f"keypoints must have shape (..., K, 2), pixels: got {points.shape}; a third column "
            "is the confidence, which is an argument of its own."
        )
    batch, count = points.shape[:-2], points.shape[-2]
    if 0 in points.shape:
        raise ValueError(f"keypoints must hold a person and a point: got shape {points.shape}.")
    if confidence is None:
        trust = jnp.ones(points.shape[:-1], points.dtype)
    else:
        trust = _stacked("confidence", confidence).astype(points.dtype)
        if trust.shape[-1:] != (count,):
            raise ValueError(
                f"confidence must have shape (..., {count}), one number a keypoint: got "
                f"{trust.shape}."
            )
        trust = _broadcast("confidence", trust, (*batch, count))
    if placed is not None:
        trust = trust * jnp.asarray(np.array(placed), trust.dtype).reshape(*[1] * len(batch), count)
    _check_values(points, trust)
    # What is not seen may hold anything; it must not reach a product, not even with zero.
    points = jnp.where(trust[..., None] > 0, points, 0.0).reshape(-1, count, 2)
    trust = trust.reshape(-1, count)
    if expected_error is None:
        pixels = _share_of_size(points, trust)
    else:
        pixels = _one_each("expected_error", expected_error, batch, points.dtype)
    scale = None if robust is None else _one_each("robust", robust, batch, points.dtype) / pixels
    people = Person(points, trust, pixels, scale, _starts(body, start, batch, points.dtype))
    return people, batch


def _stacked(name: str, given: Any) -> Float[Array, "..."]:
    if isinstance(given, (list, tuple)):
        rows = [np.shape(one) for one in given]
        if any(row != rows[0] for row in rows):
            raise ValueError(
                f"{name} must have one shape for all people of a list: got {rows}; give what was "
                "not seen a confidence of 0."
            )
        if any(isinstance(one, Tracer) for one in given):
            given = jnp.stack([jnp.asarray(one) for one in given])
    try:
        array = jnp.asarray(given)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must hold numbers: got {type(given).__name__}.") from error
    # Whole pixels, "seen" as true or false, and half precision, which no solver works in.
    half = jnp.issubdtype(array.dtype, jnp.floating) and jnp.finfo(array.dtype).bits < 32
    mask = name == "confidence" and array.dtype == bool
    if half or mask or jnp.issubdtype(array.dtype, jnp.integer):
        array = array.astype(jnp.zeros(0).dtype)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        raise TypeError(f"{name} must be floating-point: got dtype {array.dtype}.")
    return array


def _check_values(points, trust) -> None:
    if isinstance(points, Tracer) or isinstance(trust, Tracer):
        return
    sure = np.asarray(trust)
    if not (np.isfinite(sure) & (sure >= 0)).all():
        raise ValueError(
            "confidence must be finite and not negative: got "
            f"{sure[~(np.isfinite(sure) & (sure >= 0))][0]}; 0 means not seen."
        )
    lost = (sure > 0) & ~np.isfinite(np.asarray(points)).all(axis=-1)
    if lost.any():
        raise ValueError(
            f"keypoints must be finite where their confidence is not 0: got "
            f"{int(lost.sum())} that are not, the first at {np.argwhere(lost)[0].tolist()}; set "
            "their confidence to 0."
        )
    unseen = ~(sure > 0).any(axis=-1)
    if unseen.any():
        which = np.argwhere(unseen)[0].tolist()
        raise ValueError(
            "confidence must be above 0 for a keypoint of every person: got none"
            + (f" for person {which}" if which else "")
            + "; leave out people of whom nothing was seen."
        )


@jax.jit
def _share_of_size(points, trust) -> Float[Array, "people"]:
    seen = trust[..., None] > 0
    low = jnp.min(jnp.where(seen, points, jnp.inf), axis=1)
    high = jnp.max(jnp.where(seen, points, -jnp.inf), axis=1)
    side = jnp.max(high - low, axis=-1)
    # One point, or several in one place, have no size: half a pixel then.
    return jnp.maximum(_EXPECTED_SHARE * jnp.where(jnp.isfinite(side), side, 0.0), 0.5)


def _starts(body, start, batch, dtype) -> Variables:
    pose, shape, translation = start
    rows = {
        "pose": (pose, (body.num_joints, 3)),
        "shape": (np.zeros(body.num_shape) if shape is None else shape, (body.num_shape,)),
        "translation": (np.zeros(3) if translation is None else translation, (3,)),
    }
    found = []
    for name, (value, wanted) in rows.items():
        try:
            array = jnp.asarray(value).astype(dtype)
        except (TypeError, ValueError) as error:
            raise TypeError(f"{name} must hold numbers: got {type(value).__name__}.") from error
        if name == "shape" and array.ndim and array.shape[-1] < body.num_shape:
            widths = [(0, 0)] * (array.ndim - 1) + [(0, body.num_shape - array.shape[-1])]
            array = jnp.pad(array, widths)
        if array.shape[-len(wanted) :] != wanted:
            sizes = ", ".join(str(size) for size in wanted)
            raise ValueError(f"{name} must have shape (..., {sizes}): got {array.shape}.")
        if not isinstance(array, Tracer) and not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite: got values that are not.")
        array = _broadcast(name, array, (*batch, *wanted))
        found.append(array.reshape(-1, *wanted))
    return Variables(*found)


def _broadcast(name: str, array, shape: tuple[int, ...]):
    try:
        return jnp.broadcast_to(array, shape)
    except ValueError:
        raise ValueError(
            f"{name} must fit the batch axes of keypoints, {shape}: got shape {array.shape}."
        ) from None


def _one_each(name: str, value: Any, batch: tuple[int, ...], dtype) -> Float[Array, "people"]:
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError):
        array = None
    real = (jnp.floating, jnp.integer)
    if array is None or not any(jnp.issubdtype(array.dtype, kind) for kind in real):
        raise TypeError(f"{name} must be a number, or one for each person: got {value!r}.")
    if not isinstance(array, Tracer) and not ((array > 0) & (array < np.inf)).all():
        raise ValueError(f"{name} must be positive and finite: got {value!r}.")
    return _broadcast(name, array.astype(dtype), batch).reshape(-1)


def count_points(keypoints: Any) -> int:
    """The number of keypoints, for the layout to be checked against."""
    first = keypoints
    if isinstance(keypoints, (list, tuple)) and len(keypoints) and np.ndim(keypoints[0]) > 1:
        first = keypoints[0]
    shape = np.shape(first)
    if len(shape) < 2 or shape[-1] != 2:
        raise ValueError(
            f"keypoints must have shape (..., K, 2), pixels: got {shape}; a third column is the "
            "confidence, which is an argument of its own."
        )
    return shape[-2]
