"""What the arrays of a body model's file must be: each refusal names file, field and rule."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

# What a model's number may be at most: no vertex is a kilometre from the pelvis.
_LARGEST = 1e3
_MOST_ROUNDING = 1e-3  # of weights, which some files store as float16


def check_shape(name: str, array: np.ndarray, shape: tuple, path: Path) -> None:
    """Refuse what is no array of finite real numbers of a shape; None stands for any length."""
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in "fiu":
        wanted = ", ".join("any" if want is None else str(want) for want in shape)
        raise ValueError(
            f"{name} in {path} must be real numbers of shape ({wanted}): got dtype {array.dtype} "
            f"and shape {array.shape}; the file is damaged, or not a body model."
        )
    if not np.isfinite(array).all():
        raise ValueError(
            f"{name} in {path} must be finite: got {np.count_nonzero(~np.isfinite(array))} NaN or "
            "infinite entries; the file is damaged: download it again."
        )
    # Indices are whole numbers of any size; the root's parent is 4294967295.
    if name not in ("f", "kintree_table") and array.size:
        largest = max(float(array.max()), -float(array.min()))
        if largest > _LARGEST:
            raise ValueError(
                f"{name} in {path} must be within {_LARGEST:g} of zero, in metres or as a share: "
                f"got {largest:g}; the file is damaged, or not a body model."
            )


def whole_numbers(name: str, array: np.ndarray, path: Path) -> np.ndarray:
    """Indices as int64; some files store them as floats, which are not to be cut off."""
    if array.dtype.kind == "f" and not (array == np.floor(array)).all():
        wrong = array[array != np.floor(array)]
        raise ValueError(
            f"{name} in {path} must hold whole numbers: got {wrong.flat[0]:g}; the file is damaged."
        )
    if array.size and float(np.abs(array.astype(np.float64)).max()) > 2**62:
        raise ValueError(f"{name} in {path} holds numbers beyond all indices; it is damaged.")
    return array.astype(np.int64)


def check_weights(name: str, weights: np.ndarray, path: Path) -> None:
    """Refuse skinning weights that are negative or do not sum to 1."""
    if not weights.size:
        return
    if weights.min() < -_MOST_ROUNDING:
        row, column = np.unravel_index(int(weights.argmin()), weights.shape)
        raise ValueError(
            f"{name} in {path} must not be negative: got {weights.min():.4g} for vertex {row} and "
            f"joint {column}; the file is damaged."
        )
    totals = weights.sum(axis=1, dtype=np.float64)
    if np.abs(totals - 1).max() > _MOST_ROUNDING:
        worst = int(np.abs(totals - 1).argmax())
        raise ValueError(
            f"{name} in {path} must sum to 1 for each vertex: got {totals[worst]:.4f} for vertex "
            f"{worst}; divide each row by its sum."
        )


def check_regressor(regressor: np.ndarray, path: Path) -> None:
    """Refuse a regressor whose rows do not sum to 1."""
    # Its entries may be negative, but a joint that is no mean of vertices does not move with them.
    totals = regressor.sum(axis=1, dtype=np.float64)
    if totals.size and np.abs(totals - 1).max() > 10 * _MOST_ROUNDING:
        worst = int(np.abs(totals - 1).argmax())
        raise ValueError(
            f"J_regressor in {path} must sum to 1 for each joint: got {totals[worst]:.4f} for "
            f"joint {worst}; the file is damaged."
        )


def parents_of(table: np.ndarray, names: Sequence[str], path: Path) -> tuple[int, ...]:
    """The parents' columns; the root's entry, 4294967295 or -1 as the file has it, is not read."""
    column = {int(joint): k for k, joint in enumerate(table[1])}
    parents = [-1]
    for k, (joint, parent) in enumerate(zip(table[1, 1:], table[0, 1:], strict=True), start=1):
        if int(parent) not in column:
            raise ValueError(
                f"kintree_table in {path} must name a parent for each joint: got {int(parent)} "
                f"for joint {int(joint)}, which is no joint of the table."
            )
        if column[int(parent)] >= k:
            raise ValueError(
                f"kintree_table in {path} must be a tree in order, each parent before its "
                f"children: got {names[column[int(parent)]]} as the parent of {names[k]}; the "
                "table has a cycle or is out of order: download the file again."
            )
        parents.append(column[int(parent)])
    return tuple(parents)
