"""What JAX asks the host for: functions of one mesh that never raise, NumPy and SciPy alone.

They stand here, and not beside the public functions that call them, because other processes run
them as well (`bridge/worker.py`): a worker that imports no JAX starts in a third of the time and
takes half of the memory.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Int8

from spt_jax.overlap.convex import is_small_convex_solid
from spt_jax.overlap.criteria import CRITERIA
from spt_jax.overlap.exclusions import Exclusions
from spt_jax.overlap.folds import expect_folds, only_folds
from spt_jax.overlap.inflation import Inflated
from spt_jax.overlap.measure import (
    Gradient,
    Measurement,
    OpenSheets,
    Rule,
    Sampling,
    Unmeasurable,
    check_usable,
    measure,
)
from spt_jax.overlap.sheet_labels import labels_beside_sheets
from spt_jax.overlap.sheets import SheetInSolids

SheetValue = Literal["area", "depth"]
Vertices = Float[np.ndarray, "V 3"]
Faces = Int[np.ndarray, "F 3"]


class PenaltyOptions(NamedTuple):
    """What the penalty is asked for, checked, hashable, and known to other processes.

    Attributes:
        value, gradient, rule, sampling, exclusions: as the arguments of
            `self_intersection_penalty`.
        rounding: machine epsilon of the vertices as the caller has them.
        outwards: how far the surface is moved along its normals before it is measured.
    """

    value: str
    gradient: Gradient
    rule: Rule
    sampling: Sampling
    exclusions: Exclusions
    rounding: float
    outwards: float = 0.0


class SheetOptions(NamedTuple):
    """What a sheet beside solids is asked for.

    Attributes:
        value: as the argument of `sheet_penalty`.
        solids: how many of the faces are the solids'; the sheet's follow.
        rounding: machine epsilon of the vertices as the caller has them.
    """

    value: SheetValue
    solids: int
    rounding: float


class LabelOptions(NamedTuple):
    """What the labels are asked for; see `PenaltyOptions`."""

    rule: Rule
    sampling: Sampling
    exclusions: Exclusions
    rounding: float


def value_on_host(
    vertices: Vertices, faces: Faces, options: PenaltyOptions | SheetOptions
) -> tuple[Float[np.ndarray, ""], ...]:
    """The penalty alone; NaN where the mesh cannot be measured."""
    if isinstance(options, SheetOptions):
        return _of_sheet(vertices, faces, options)[:1]
    return measured(vertices, faces, options, with_gradient=False)[:1]


def value_and_gradient_on_host(
    vertices: Vertices, faces: Faces, options: PenaltyOptions | SheetOptions
) -> tuple[Float[np.ndarray, ""], Float[np.ndarray, "V 3"]]:
    """The penalty and its gradient; NaN and zeros where the mesh cannot be measured."""
    if isinstance(options, SheetOptions):
        return _of_sheet(vertices, faces, options)
    return measured(vertices, faces, options, with_gradient=True)[:2]


def labels_on_host(
    vertices: Vertices, faces: Faces, options: LabelOptions
) -> tuple[Int8[np.ndarray, "V"]]:
    """The label of each vertex; all are clear where the mesh cannot be measured."""
    try:
        try:
            found = measure(vertices, faces, options.sampling, options.exclusions, options.rounding)
        except OpenSheets:
            return (labels_beside_sheets(vertices, faces, *options),)
        return (found.labels(options.rule),)
    except Unmeasurable:
        return (np.zeros(len(vertices), np.int8),)


def measured(
    vertices: Vertices, faces: Faces, options: PenaltyOptions, *, with_gradient: bool
) -> tuple[Float[np.ndarray, ""], Float[np.ndarray, "V 3"], Measurement | None]:
    """Value, gradient, and what was measured; None where there is no overlap, or no measure."""
    nothing, criterion = np.zeros_like(vertices), CRITERIA[options.value]
    moved = None
    try:
        check_usable(vertices, faces, options.rounding)
        if options.outwards and faces.size:
            moved = Inflated(vertices, faces, options.outwards, options.rounding)
            vertices = moved.vertices
            check_usable(vertices, faces, options.rounding)
        exact = options.sampling.rays is None
        if exact and is_small_convex_solid(vertices, faces, options.rounding):
            return np.zeros(()), nothing, None
        found = _measured_unless_zero(vertices, faces, options)
        if found is None:
            return np.zeros(()), nothing, None
        value = np.array(criterion.of(found, options.rule), np.float64)
        if options.exclusions.rest is not None:
            expect_folds(faces, len(vertices), bool(value == 0))
        gradient = nothing
        if with_gradient and criterion.slope is not None:
            gradient = criterion.slope(found)
        elif with_gradient:
            gradient = found.gradient(options.gradient, options.rule)
        if moved is not None:
            gradient = moved.pulled_back(gradient)
    except Unmeasurable:
        return np.array(np.nan), nothing, None
    value, gradient = _as_held(value, gradient, options.rounding, least=criterion.power > 0)
    known = np.isfinite(value) and (value > 0 or criterion.power <= 0)
    return value, gradient, found if known else None


def _measured_unless_zero(
    vertices: Vertices, faces: Faces, options: PenaltyOptions
) -> Measurement | None:
    """The mesh measured; None where it is shown to be zero by less."""
    if faces.size == 0:
        return None
    # Whether it is asked at first depends on the shapes before. What is returned must not: so
    # where a measurement fails or falls back on rays it is asked at last.
    asked = options.sampling.rays is None and CRITERIA[options.value].power > 0
    if asked and only_folds(vertices, faces, options.exclusions):
        return None
    try:
        found = measure(vertices, faces, options.sampling, options.exclusions, options.rounding)
    except Unmeasurable:
        if asked and only_folds(vertices, faces, options.exclusions, surely=True):
            return None
        raise
    if asked and not found.exact and only_folds(vertices, faces, options.exclusions, surely=True):
        return None
    return found


def _of_sheet(vertices: Vertices, faces: Faces, options: SheetOptions):
    try:
        found = SheetInSolids(vertices, faces, options.solids, options.rounding)
        value, gradient = found.area() if options.value == "area" else found.depth()
    except Unmeasurable:
        return np.array(np.nan), np.zeros_like(vertices)
    return _as_held(np.array(value), gradient, options.rounding, least=True)


def _as_held(value, gradient, rounding: float, *, least: bool):
    """Value and gradient as the vertices' dtype can hold them, NaN and zeros where it cannot."""
    # Measured in float64: it may be more than the vertices' dtype can hold, or less.
    narrow = rounding > np.finfo(np.float64).eps
    held = np.finfo(np.float32 if narrow else np.float64)
    if not (abs(value) <= held.max and (np.abs(gradient) <= held.max).all()):
        return np.array(np.nan), np.zeros_like(gradient)
    if least and value < held.tiny:
        # There is no overlap, or one within rounding of none: no slope.
        return np.zeros(()), np.zeros_like(gradient)
    return value, gradient
