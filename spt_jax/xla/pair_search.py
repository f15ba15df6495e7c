"""All pairs of triangles that intersect, with arrays of fixed sizes.

Triangles are put in the order of a Morton curve through their centers, and every 16 of them make a
cluster with a box. Clusters are tested against all clusters, 128 of them at once; pairs of clusters
and then pairs of triangles whose boxes meet are taken up a fixed number at a time for as long as
there are any, so that nothing can overflow. The cost grows with the square of the triangles / 256:
0.3 M tests of boxes for the embedded body, 2 G for a million triangles.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from spt_jax.xla.arrays import cumulative_sum, take
from spt_jax.xla.triangle_pairs import triangles_intersect

CLUSTER = 16
# Clusters, pairs of clusters, of triangles and of intersecting ones that are worked on at once.
_ROWS, _CLUSTER_PAIRS, _PAIRS, _INTERSECTING = 128, 1024, 1 << 14, 256
# Of the curve: bits of each coordinate.
_BITS = 10


class Boxes(NamedTuple):
    """Boxes along the axes; empty where the low end is above the high one."""

    low: Float[Array, "*N 3"]
    high: Float[Array, "*N 3"]


def over_intersecting_pairs(
    vertices: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    add: Callable[[Any, Int[Array, "P"], Int[Array, "P"], Bool[Array, "P"]], Any],
    sums: Any,
) -> Any:
    """`sums = add(sums, first, second, intersects)` for all pairs that intersect.

    Args:
        vertices, faces: finite, and in range.
        add: given some hundreds of pairs, and which of them intersect; every pair that does is
            given once.
        sums: what `add` begins with.
    """
    face, boxes = _in_order(vertices, faces)
    clusters = Boxes(boxes.low.min(axis=1), boxes.high.max(axis=1))
    count = len(face)
    number = jnp.arange(count, dtype=jnp.int32)

    def some_clusters(sums, begin):
        row = begin + jnp.arange(min(_ROWS, count), dtype=jnp.int32)
        mine = Boxes(*(take(side, row)[:, None] for side in clusters))
        meet = _meet(mine, Boxes(*(side[None] for side in clusters)))
        meet &= (row[:, None] <= number[None, :]) & (row[:, None] < count)

        def some_pairs(sums, index, used):
            first, second = begin + index // count, index % count
            of_first, of_second = (Boxes(*(take(s, c) for s in boxes)) for c in (first, second))
            meet = _meet(
                Boxes(*(side[:, :, None] for side in of_first)),
                Boxes(*(side[:, None, :] for side in of_second)),
            )
            place = jnp.arange(CLUSTER, dtype=jnp.int32)
            before = (place[:, None] < place[None, :])[None]
            meet &= used[:, None, None] & ((first != second)[:, None, None] | before)

            def some_triangles(sums, index, used):
                pair, at = index // CLUSTER**2, index % CLUSTER**2
                f = take(face, take(first, pair))[jnp.arange(len(at)), at // CLUSTER]
                g = take(face, take(second, pair))[jnp.arange(len(at)), at % CLUSTER]
                intersects = triangles_intersect(vertices, take(faces, f), take(faces, g))

                def some_intersecting(sums, index, used):
                    return add(sums, take(f, index), take(g, index), used)

                return _over_true(intersects & used, _INTERSECTING, some_intersecting, sums)

            return _over_true(meet.reshape(-1), _PAIRS, some_triangles, sums)

        return _over_true(meet.reshape(-1), _CLUSTER_PAIRS, some_pairs, sums)

    begins = jnp.arange(0, count, _ROWS, dtype=jnp.int32)
    return jax.lax.scan(lambda sums, begin: (some_clusters(sums, begin), None), sums, begins)[0]


def _in_order(vertices, faces) -> tuple[Int[Array, "C 16"], Boxes]:
    """The triangles of each cluster, and their boxes; what fills the last one up is empty."""
    corner = vertices[faces]
    low, high = corner.min(axis=1), corner.max(axis=1)
    center = (low + high) / 2
    lowest = center.min(axis=0)[None]
    extent = (center - lowest).max()
    step = (2**_BITS - 1) / jnp.where(extent > 0, extent, jnp.ones_like(extent))
    code = ((center - lowest) * step).astype(jnp.int32)
    key = jnp.zeros(len(faces), jnp.int32)
    for bit in range(_BITS):
        for axis in range(3):
            key |= ((code[:, axis] >> bit) & 1) << (3 * bit + axis)
    order = jnp.argsort(key).astype(jnp.int32)
    spare = -len(faces) % CLUSTER

    def arranged(side, beyond):
        side = jnp.concatenate([side[order], jnp.full((spare, 3), beyond, side.dtype)])
        return side.reshape(-1, CLUSTER, 3)

    order_16 = jnp.pad(order, (0, spare)).reshape(-1, CLUSTER)
    return order_16, Boxes(arranged(low, jnp.inf), arranged(high, -jnp.inf))


def _meet(one: Boxes, other: Boxes) -> Bool[Array, "..."]:
    return ((one.low <= other.high) & (other.low <= one.high)).all(axis=-1)


def _over_true(mask: Bool[Array, "N"], size: int, add: Callable, sums: Any) -> Any:
    """`add(sums, index, used)` with the indices at which the mask is true, `size` at a time."""
    total = cumulative_sum(mask.astype(jnp.int32))
    count = total[-1]

    def step(state):
        begin, sums = state
        wanted = begin + jnp.arange(size, dtype=jnp.int32)
        used = wanted < count
        index = jnp.searchsorted(total, jnp.where(used, wanted + 1, 1)).astype(jnp.int32)
        return begin + size, add(sums, index, used)

    return jax.lax.while_loop(lambda state: state[0] < count, step, (jnp.int32(0), sums))[1]
