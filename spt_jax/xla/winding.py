"""The winding number just outside every vertex: a ray through each against all triangles.

A ray through vertex p meets p's own triangles at p, and others in front of p and behind it. With
+1 where it enters and -1 where it leaves, let F be the sum in front, B the one behind and O that
of p's own triangles. On a closed mesh F + O + B = 0; the winding number is F just before p and
F + O just after. Where O is +1 or -1 the ray goes through the surface at p, whose outer side has
w_out = min(F, F + O). Where O is 0 the ray only touches the surface there, as on a silhouette:
either both of its sides are outside the cone of p's triangles, and w_out = F, or both are within,
and w_out = F - 1. The part of the cone that is nearest to the ray decides which (`cone.py`).

The host follows the winding number along the surface instead (`overlap.triangles.winding`); the two
may differ at a vertex whose own triangles pass through one another, which has several.

Vertices are put into strips of the screen, equally many each, and sorted along the strip, so that a
triangle meets few vertices that it cannot contain. Triangle by strip, and then triangle by vertex,
are lists of unknown length; they are worked off in pieces, so that no list is too long for its
array.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spt_jax.overlap.measure import Directions
from spt_jax.overlap.rays.beam import screen_frame
from spt_jax.xla.arrays import cumulative_sum, expand, last_within, take
from spt_jax.xla.cone import within_cone

# The rays lean from the direction that is asked for, by these parts of the screen's axes, and the
# screen is turned about them: what is modelled has its faces and edges along the axes, and a face
# seen exactly edge-on is met or missed by rounding.
_LEAN = (0.1381966011250105, 0.0901699437494742)
_TURN = np.arctan((np.sqrt(5.0) - 1.0) / 2.0)

# For vertices whose rays meet a hole in all of the caller's directions.
_SPARE = np.array([[0.48, -0.36, -0.8], [-0.64, 0.6, -0.48]])

# A sheet nearer to the vertex than this part of the mesh's size touches it, as in `levels.py`.
_THINNEST = 1e-7

# Pieces of the two lists, at most.
_MOST_RUNS, _MOST_PAIRS = 1 << 16, 1 << 17


def generic_frames(directions: Directions) -> Float[np.ndarray, "D 3 3"]:
    """The frames of rays along each direction, and along two of our own."""
    rows = [*(np.array(direction) for direction in directions), *_SPARE]
    return np.stack([_generic_frame(row) for row in rows])


def vertex_labels(
    vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"], frames: Float[Array, "D 3 3"]
) -> Int[Array, "V"]:
    """The label sign(w_out) of every vertex: +1 penetrating, -1 inverted, 0 clear.

    The first of the frames (`generic_frames`) serves all vertices; the next ones those whose ray
    met a hole. A vertex that none decides is 0, and so is one that no triangle uses.
    """
    used = jnp.zeros(len(vertices), jnp.int32).at[faces.reshape(-1)].max(1) > 0

    def more(state):
        turn, _, undecided = state
        return (turn < len(frames)) & undecided.any()

    def look(state):
        turn, label, undecided = state
        least, most, closed = _bounds(vertices, faces, frames[turn])
        nearest = jnp.minimum(jnp.maximum(0, least), most)
        decided = undecided & closed
        return turn + 1, jnp.where(decided, jnp.sign(nearest), label), undecided & ~closed

    start = jnp.int32(0), jnp.zeros(len(vertices), jnp.int32), used
    return jax.lax.while_loop(more, look, start)[1]


def _generic_frame(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The frame of rays along a direction, leant and turned away from everything modelled."""
    u, v, d = screen_frame(direction.astype(np.float64))
    return screen_frame(d + _LEAN[0] * u + _LEAN[1] * v, _TURN)


class _Grid(NamedTuple):
    """The vertices by their rank from the screen's lowest row to its highest.

    Strips hold `height` ranks each; `key` is strip * V + place of the vertices, sorted, where place
    is the order along a row; vertices of one column share it.
    """

    points: Float[Array, "V 3"]  # by rank
    rank: Int[Array, "V"]  # of each vertex of the mesh
    place: Int[Array, "V"]  # of each vertex of the mesh
    key: Int[Array, "V"]
    sorted: Int[Array, "V"]  # ranks in the order of keys
    height: int


def _grid(screen: Float[Array, "V 3"]) -> _Grid:
    num = len(screen)
    strips = min(int(np.sqrt(num)) + 1, (2**31 - 1) // num)
    height = -(-num // strips)
    index = jnp.arange(num, dtype=jnp.int32)
    _, order = jax.lax.sort((screen[:, 1], index), num_keys=1)
    rank = jnp.zeros(num, jnp.int32).at[order].set(index)
    points = take(screen, order)
    ascending, along = jax.lax.sort((screen[:, 0], index), num_keys=1)
    rises = jnp.concatenate([jnp.zeros(1, bool), ascending[1:] > ascending[:-1]])
    place = jnp.zeros(num, jnp.int32).at[along].set(cumulative_sum(rises.astype(jnp.int32)))
    key = index // height * num + take(place, order)
    key, in_order = jax.lax.sort((key, index), num_keys=1)
    return _Grid(points, rank, place, key, in_order, height)


class _Triangles(NamedTuple):
    low: Int[Array, "F"]
    mid: Int[Array, "F"]
    high: Int[Array, "F"]
    even: Bool[Array, "F"]  # whether (low, mid, high) goes around as the triangle does
    edges: Float[Array, "F 3 6"]  # low-high, low-mid, mid-high: start, and what it adds to the end
    tilt: Float[Array, "F"]  # |cosine| of the normal and the ray; 0 without a normal


def _triangles(grid: _Grid, faces: Int[Array, "F 3"]) -> _Triangles:
    ranks = take(grid.rank, faces)
    a, b, c = ranks.T
    low, high = ranks.min(axis=1), ranks.max(axis=1)
    mid = a + b + c - low - high
    even = ~((a < b) ^ (b < c) ^ (c < a))
    start = grid.points[jnp.stack([low, low, mid], axis=1)]
    end = grid.points[jnp.stack([high, mid, high], axis=1)]
    along = end - start
    normal = jnp.cross(along[:, 0], along[:, 1])
    norm = jnp.sqrt((normal * normal).sum(axis=1))
    tilt = jnp.abs(normal[:, 2]) / jnp.where(norm > 0, norm, jnp.ones_like(norm))
    return _Triangles(low, mid, high, even, jnp.concatenate([start, along], axis=2), tilt)


def _left_of(edge: Float[Array, "K 6"], point: Float[Array, "K 3"]) -> Bool[Array, "K"]:
    # Both triangles of an edge compute the same, so that signs cancel whatever the rounding.
    x, y = point[:, 0] - edge[:, 0], point[:, 1] - edge[:, 1]
    return x * edge[:, 4] < y * edge[:, 3]


def _bounds(
    vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"], frame: Float[Array, "3 3"]
) -> tuple[Int[Array, "V"], Int[Array, "V"], Bool[Array, "V"]]:
    """The least and the greatest winding number that is right, and whether the signs cancel."""
    axes = [(vertices * frame[k][None, :]).sum(axis=1) for k in range(3)]
    screen = jnp.stack(axes, axis=1)
    grid = _grid(screen)
    triangles = _triangles(grid, faces)
    extent = (screen.max(axis=0) - screen.min(axis=0)).max()
    thinnest = max(_THINNEST, 4 * float(jnp.finfo(vertices.dtype).eps)) * extent

    # A row belongs to an edge from its lower end up to below its higher one, and a point on an
    # edge is not to the left of it: of its own corners a triangle contains at most the middle one.
    contains = _left_of(triangles.edges[:, 0], take(grid.points, triangles.mid))
    sign = jnp.where(contains, jnp.where(triangles.even, -1, 1), 0)
    own = jnp.zeros(len(vertices), jnp.int32).at[triangles.mid].add(sign.astype(jnp.int32))
    least, most, total = (take(w, grid.rank) for w in _others(grid, triangles, faces, thinnest))
    own = take(own, grid.rank)

    within, has_sides = within_cone(vertices, faces, -frame[2])
    grazed = own == 0
    least = least + jnp.minimum(own, 0) - (grazed & within).astype(jnp.int32)
    most = most + jnp.maximum(own, 0) - 1 + (grazed & ~within).astype(jnp.int32)
    return least, most, (total + own == 0) & (~grazed | has_sides)


def _others(
    grid: _Grid, triangles: _Triangles, faces: Int[Array, "F 3"], thinnest: Float[Array, ""]
) -> tuple[Int[Array, "V"], Int[Array, "V"], Int[Array, "V"]]:
    """By rank: the least and the greatest sum in front of each vertex, and the sum of all."""
    num = len(grid.rank)
    places = take(grid.place, faces)
    left, right = places.min(axis=1), places.max(axis=1)
    first = (triangles.low + 1) // grid.height
    strips = (triangles.high - 1) // grid.height - first + 1
    strips = jnp.where((triangles.high - triangles.low > 1) & (left < right), strips, 0)
    num_runs = strips.sum(dtype=jnp.int32)
    most_runs = min(_MOST_RUNS, max(2 * len(faces), 1 << 10))
    most_pairs = max(min(_MOST_PAIRS, 4 * len(faces)), grid.height, 1 << 10)

    def next_piece(state):
        done, least, most, total = state
        face, step, used = expand(strips, most_runs, done)
        begin_of = (take(first, face) + step) * num
        begin = jnp.searchsorted(grid.key, begin_of + take(left, face)).astype(jnp.int32)
        end = jnp.searchsorted(grid.key, begin_of + take(right, face)).astype(jnp.int32)
        width = jnp.where(used, end - begin, 0)
        sums = jnp.concatenate([jnp.zeros(1, jnp.int32), cumulative_sum(width)])
        taken = last_within(sums, jnp.int32(0), most_pairs)
        width = jnp.where(jnp.arange(most_runs, dtype=jnp.int32) < taken, width, 0)
        run, step, used = expand(width, most_pairs)
        vertex, face = take(grid.sorted, take(begin, run) + step), take(face, run)
        inside = (vertex > take(triangles.low, face)) & (vertex < take(triangles.high, face))
        inside &= used & (vertex != take(triangles.mid, face))
        sign, ahead, touches = _crossings(grid, triangles, vertex, face, thinnest)
        sign = jnp.where(inside, sign, 0)
        in_front = jnp.where((ahead < 0) & ~touches, sign, 0)
        # What touches is in front or behind, as is needed.
        less = in_front + jnp.where(touches, jnp.minimum(sign, 0), 0)
        more = in_front + jnp.where(touches, jnp.maximum(sign, 0), 0)
        added = jnp.stack([less, more, sign], axis=1)
        least, most, total = (jnp.stack([least, most, total], axis=1).at[vertex].add(added)).T
        return done + taken, least, most, total

    zeros = jnp.zeros(num, jnp.int32)
    state = jnp.int32(0), zeros, zeros, zeros
    return jax.lax.while_loop(lambda state: state[0] < num_runs, next_piece, state)[1:]


def _crossings(
    grid: _Grid,
    triangles: _Triangles,
    vertex: Int[Array, "P"],
    face: Int[Array, "P"],
    thinnest: Float[Array, ""],
) -> tuple[Int[Array, "P"], Float[Array, "P"], Bool[Array, "P"]]:
    """Sign (0: they do not meet), depth behind the vertex and whether they touch, pair by pair."""
    upper = vertex >= take(triangles.mid, face)
    point, edges = take(grid.points, vertex), take(triangles.edges, face)
    long, short = edges[:, 0], jnp.where(upper[:, None], edges[:, 2], edges[:, 1])
    left_of_short = _left_of(short, point)
    met = _left_of(long, point) != left_of_short
    # Counter-clockwise, facing the ray, where an even triangle has its short edges on the right.
    sign = jnp.where(met, jnp.where(take(triangles.even, face) == left_of_short, 1, -1), 0)
    # Interpolated between the edges, never extrapolated from the plane.
    (x_long, z_long), (x_short, z_short) = _on_row(long, point), _on_row(short, point)
    across = x_short - x_long
    across = jnp.clip(-x_long / jnp.where(across != 0, across, jnp.ones_like(across)), 0.0, 1.0)
    ahead = z_long + across * (z_short - z_long)
    # How far the plane is, not how far along the ray.
    near = jnp.abs(ahead) < 1e3 * thinnest
    sign = sign.astype(jnp.int32)
    return sign, ahead, near & (jnp.abs(ahead) * take(triangles.tilt, face) <= thinnest)


def _on_row(
    edge: Float[Array, "P 6"], point: Float[Array, "P 3"]
) -> tuple[Float[Array, "P"], Float[Array, "P"]]:
    """Column and depth, from the point's, at which an edge passes its row."""
    start, rise = edge[:, :3] - point, edge[:, 4]
    part = -start[:, 1] / jnp.where(rise != 0, rise, jnp.ones_like(rise))
    return start[:, 0] + part * edge[:, 3], start[:, 2] + part * edge[:, 5]
