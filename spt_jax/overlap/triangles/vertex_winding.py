"""The winding number just outside every vertex: a ray through each vertex against all triangles.

A ray through vertex p meets p's own triangles at p, and others in front of p and behind it. With
+1 where it enters and -1 where it leaves, let F be the sum in front, B the one behind and O that
of p's own triangles. On a closed mesh F + O + B = 0; the winding number is F just before p and
F + O just after. Where O is +1 or -1 the ray goes through the surface at p, whose outer side has
w_out = min(F, F + O). Where O is 0 the ray only touches the surface there, as on a silhouette:
either both of its sides are outside the cone of p's triangles, and w_out = F, or both are within,
and w_out = F - 1. The part of the cone that is nearest to the ray tells which, so that one
direction decides every vertex of a closed mesh.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.rays.beam import screen_frame
from spt_jax.overlap.triangles.vertex_cone import within_cone
from spt_jax.overlap.triangles.vertex_sample import around, used_alone

# The rays lean from the direction that is asked for, by these parts of the screen's axes, and the
# screen is turned about them: what is modelled has its faces and edges along the axes, and a face
# seen exactly edge-on is met or missed by rounding.
_LEAN = (0.1381966011250105, 0.0901699437494742)
_TURN = np.arctan((np.sqrt(5.0) - 1.0) / 2.0)

# For vertices whose rays meet a hole in all of the caller's directions.
SPARE = np.array([[0.48, -0.36, -0.8], [-0.64, 0.6, -0.48]])

# A sheet nearer to the vertex than this part of the mesh's size touches it, as in `rays.levels`.
THINNEST = 1e-7

# How many strips the screen is cut into, and columns, for each root of the number of vertices.
# With fewer strips a triangle is paired with more vertices that it cannot contain, with more it
# is looked up more often: on a body all of 1 to 2 cost the same.
_STRIPS, _COLUMNS = 1.0, 6.0

# Triangles, and pairs of a vertex and a triangle, that are worked on together. So few that memory
# is used again rather than asked for again, which takes a third off the time; but in proportion
# to the vertices, since each of these turns adds to a sum for every vertex.
_FACES, _PAIRS = 1 << 12, 1 << 15

# A sample of fewer than this part of the vertices is told from the triangles around it alone:
# 0.9 ms for a few vertices of a body where all take 18.
_FEW = 0.1

# Two numbers below 2^31 in one integer, and its bits where a borrow shows that a difference of
# two such integers is negative in one of its halves: one test for a whole bounding box.
_HALF = 32
_BORROWS = np.int64(-(1 << 63)) | np.int64(1 << 31)


def vertex_winding(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    directions: Float[np.ndarray, "D 3"],
    sample: Int[np.ndarray, "S"] | None = None,
) -> Int[np.ndarray, "V"]:
    """The winding number just outside the mesh's own surface at every vertex, whatever the depth.

    Its sign is the vertex's class: 0 on V_0, +1 on V_out, -1 on V_in. The first direction serves
    all vertices; the next ones, and then two of our own, those whose ray met a hole, so that signs
    do not cancel, or only touched the rim of one. A vertex that no direction decides is 0, and
    so is one that no triangle uses.

    A sheet that touches p counts as in front of it or behind it, whichever brings w_out nearer to
    0: contact is no overlap. Where p's own triangles pass through one another there are more than
    two winding numbers around p, and w_out is one whose successor is among them too; only there
    does it depend on the direction.

    Given a sample of vertices, of which each has triangles, all others are 0.
    """
    winding = np.zeros(len(vertices), np.int64)
    vertices = vertices.astype(np.float64, copy=False)
    undecided = np.zeros(len(vertices), bool)
    undecided[faces.ravel() if sample is None else sample] = True
    with np.errstate(all="ignore"):  # what is not finite compares as false, and counts as 0
        for direction in (*directions, *SPARE):
            sample = np.flatnonzero(undecided)
            if len(sample) == 0:
                break
            frame = generic_frame(direction)
            screen = frame @ vertices.T
            thinnest = THINNEST * float(np.ptp(screen, axis=1).max())
            few = len(sample) < _FEW * len(vertices)
            near = faces[around(screen, faces, sample)] if few else faces
            own, least, most, total = _sums(*used_alone(screen, near, sample), thinnest)
            least += np.minimum(own, 0)
            most += np.maximum(own, 0) - 1
            grazed = np.flatnonzero(own == 0)
            within, has_sides = within_cone(vertices, near, sample[grazed], -frame[2])
            least[grazed] -= within
            most[grazed] += ~within
            total[grazed[~has_sides]] = 1
            closed = np.flatnonzero(total == 0)
            winding[sample[closed]] = np.clip(0, least[closed], most[closed])
            undecided[sample[closed]] = False
    return winding


def generic_frame(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The frame of rays along a direction, leant and turned away from everything modelled."""
    u, v, d = screen_frame(direction.astype(np.float64))
    return screen_frame(d + _LEAN[0] * u + _LEAN[1] * v, _TURN)


def _sums(
    screen: Float[np.ndarray, "3 V"],
    faces: Int[np.ndarray, "F 3"],
    sample: Int[np.ndarray, "S"],
    thinnest: float,
) -> Int[np.ndarray, "4 S"]:
    """O, the least F, the greatest F and F + O + B at each vertex of the sample."""
    grid = _grid(screen, sample, thinnest)
    num = len(grid.rank)
    own, least, most, total = sums = np.zeros((4, num))
    at_once = max(_FACES, num // 2)
    for first in range(0, len(faces), at_once):
        triangles = _triangles(grid, faces[first : first + at_once])
        own += _own_signs(grid, triangles)
        for vertex, face in _pairs(grid, triangles):
            vertex, sign, ahead, touches = _crossings(grid, triangles, vertex, face)
            total += np.bincount(vertex, sign, num)
            in_front = np.bincount(vertex, sign * ((ahead < 0) & ~touches), num)
            least += in_front
            most += in_front
            if touches.any():  # in front or behind, as is needed
                vertex, sign = vertex[touches], sign[touches]
                least += np.bincount(vertex, np.minimum(sign, 0), num)
                most += np.bincount(vertex, np.maximum(sign, 0), num)
    total += own
    return sums[:, grid.rank[sample]].astype(np.int64)


class _Grid(NamedTuple):
    """The vertices on the screen, named by their rank from its lowest row to its highest.

    Vertices in one row have different ranks too, so that each is above or below any other. Strips
    hold equal numbers of vertices, and so do columns: a mesh may have its vertices in one corner.
    """

    rank: Int[np.ndarray, "V"]  # of each vertex of the mesh
    x: Float[np.ndarray, "V"]  # this and what follows in the order of ranks
    y: Float[np.ndarray, "V"]
    z: Float[np.ndarray, "V"]
    place: Int[np.ndarray, "V"]  # in the order of x; vertices of one x share it
    strip: Int[np.ndarray, "V"]  # by rank
    column: Int[np.ndarray, "V"]  # by place
    num_columns: int
    point: Int[np.ndarray, "S"]  # the sample by strip and column: rank and place in one integer
    begin: Int[np.ndarray, "C"]  # where each strip's columns begin in `point`
    thinnest: float


def _grid(screen: Float[np.ndarray, "3 V"], sample: Int[np.ndarray, "S"], thinnest: float) -> _Grid:
    num = screen.shape[1]
    order = np.argsort(screen[1])
    rank = np.empty(num, np.int64)
    rank[order] = np.arange(num)
    x, y, z = screen[:, order]
    order = np.argsort(x)
    ascending = x[order]
    place = np.zeros(num, np.int64)
    place[order[1:]] = np.cumsum(ascending[1:] > ascending[:-1])

    strips, columns = (int(n * np.sqrt(len(sample))) + 1 for n in (_STRIPS, _COLUMNS))
    strip, column = np.arange(num) * strips // num, np.arange(num) * columns // num
    sampled = rank[sample]
    cell = strip[sampled] * columns + column[place[sampled]]
    sampled = sampled[np.argsort(cell)]
    begin = np.zeros(strips * columns + 1, np.int64)
    np.cumsum(np.bincount(cell, minlength=strips * columns), out=begin[1:])
    point = (sampled << _HALF) | place[sampled]
    return _Grid(rank, x, y, z, place, strip, column, columns, point, begin, thinnest)


class _Triangles(NamedTuple):
    """Some of the triangles, with their corners sorted from low to high.

    Each has three edges, from the lower to the higher end: low-high, low-mid, mid-high.
    """

    low: Int[np.ndarray, "F"]
    mid: Int[np.ndarray, "F"]
    high: Int[np.ndarray, "F"]
    even: Bool[np.ndarray, "F"]  # whether (low, mid, high) goes around as the triangle does
    start: Int[np.ndarray, "E"]
    end: Int[np.ndarray, "E"]
    start_x: Float[np.ndarray, "E"]
    start_y: Float[np.ndarray, "E"]
    run: Float[np.ndarray, "E"]
    rise: Float[np.ndarray, "E"]

    def left_of(
        self, edge: Int[np.ndarray, "N"], x: Float[np.ndarray, "N"], y: Float[np.ndarray, "N"]
    ) -> Bool[np.ndarray, "N"]:
        """Whether points are to the left of edges that cross their rows.

        Both triangles of an edge compute the same, so that signs cancel whatever the rounding.
        Points to one side of both of the edge's ends come out on that side: differences and
        products are rounded monotonely. So nothing is lost outside a bounding box.
        """
        x, y = x - self.start_x[edge], y - self.start_y[edge]
        x *= self.rise[edge]
        y *= self.run[edge]
        return x < y


def _triangles(grid: _Grid, faces: Int[np.ndarray, "F 3"]) -> _Triangles:
    a, b, c = grid.rank[faces.T]
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    mid = a + b + c - low - high
    even = ~((a < b) ^ (b < c) ^ (c < a))
    start, end = np.concatenate([low, low, mid]), np.concatenate([high, mid, high])
    x, y = grid.x[start], grid.y[start]
    run, rise = grid.x[end] - x, grid.y[end] - y
    return _Triangles(low, mid, high, even, start, end, x, y, run, rise)


def _own_signs(grid: _Grid, triangles: _Triangles) -> Float[np.ndarray, "V"]:
    # A row belongs to an edge from its lower end up to below its higher one, and a point on an
    # edge is not to the left of it: of its own corners a triangle contains at most the middle one.
    mid = triangles.mid
    contained = triangles.left_of(np.arange(len(mid)), grid.x[mid], grid.y[mid])
    return np.bincount(mid, contained * np.where(triangles.even, -1.0, 1.0), len(grid.rank))


def _pairs(
    grid: _Grid, triangles: _Triangles
) -> Iterator[tuple[Int[np.ndarray, "N"], Int[np.ndarray, "N"]]]:
    """Vertices and triangles that may contain them: all in the bounding box but its own corners."""
    place = np.stack([grid.place[w] for w in (triangles.low, triangles.mid, triangles.high)])
    left, right = place.min(axis=0), place.max(axis=0)
    face = np.flatnonzero((triangles.high - triangles.low > 1) & (left < right))
    low, high = triangles.low[face] + 1, triangles.high[face] - 1
    left, right, mid = left[face], right[face] - 1, triangles.mid[face]
    least, most = (low << _HALF) | left, (high << _HALF) | right
    first = grid.strip[low]
    strips = grid.strip[high] - first + 1
    first *= grid.num_columns
    begins, ends = first + grid.column[left], first + grid.column[right] + 1

    fewest = max(_PAIRS, len(grid.rank))
    for some in _turns(strips, fewest):
        box = np.repeat(np.arange(some.start, some.stop), strips[some])
        up = np.arange(len(box)) - np.repeat(_starts(strips[some]), strips[some])
        up *= grid.num_columns
        begin = grid.begin[up + begins[box]]
        width = grid.begin[up + ends[box]] - begin
        kept = np.flatnonzero(width)
        box, begin, width = box[kept], begin[kept], width[kept]
        for part in _turns(width, fewest):
            of = np.repeat(box[part], width[part])
            at = np.repeat(begin[part] - _starts(width[part]), width[part])
            at += np.arange(len(at))
            point = grid.point[at]
            outside = point - least[of]
            outside |= most[of] - point
            outside &= _BORROWS
            kept = np.flatnonzero(outside == 0)
            vertex, of = point[kept] >> _HALF, of[kept]
            kept = np.flatnonzero(vertex != mid[of])
            yield vertex[kept], face[of[kept]]


def _starts(sizes: Int[np.ndarray, "N"]) -> Int[np.ndarray, "N"]:
    return np.cumsum(sizes) - sizes


def _turns(sizes: Int[np.ndarray, "N"], most: int) -> Iterator[slice]:
    """Slices of about `most` in all: more only where a single size, the last, is."""
    turn = np.cumsum(sizes) // most
    cuts = [0, *(np.flatnonzero(turn[1:] != turn[:-1]) + 1).tolist(), len(sizes)]
    for start, stop in itertools.pairwise(cuts):
        yield slice(start, stop)


def _crossings(
    grid: _Grid, of: _Triangles, vertex: Int[np.ndarray, "N"], face: Int[np.ndarray, "N"]
) -> tuple[
    Int[np.ndarray, "K"], Float[np.ndarray, "K"], Float[np.ndarray, "K"], Bool[np.ndarray, "K"]
]:
    """The pairs that do meet: vertex, sign, depth behind the vertex, and whether they touch."""
    count = len(of.mid)
    short = face + count * (1 + (vertex >= of.mid[face]))
    x, y = grid.x[vertex], grid.y[vertex]
    left_of_short = of.left_of(short, x, y)
    met = np.flatnonzero(of.left_of(face, x, y) != left_of_short)
    vertex, face, short, x, y = vertex[met], face[met], short[met], x[met], y[met]
    # Counter-clockwise, facing the ray, where an even triangle has its short edges on the right.
    sign = np.where(of.even[face] == left_of_short[met], 1.0, -1.0)

    # Interpolated between the edges, never extrapolated from the plane, as in crossings.py.
    (x_long, z_long), (x_short, z_short) = _on_row(grid, of, face, y), _on_row(grid, of, short, y)
    across = np.clip((x - x_long) / (x_short - x_long), 0.0, 1.0)
    ahead = z_long + across * (z_short - z_long) - grid.z[vertex]

    # How far the plane is, not how far along the ray. A triangle that leans less than a thousandth
    # from the ray is taken to be a thousandth of its depth away.
    touches = np.abs(ahead) < 1e3 * grid.thinnest
    near = np.flatnonzero(touches)
    if len(near):
        corners = np.stack([of.low, of.mid, of.high])[:, face[near]]
        a, b, c = np.stack([grid.x, grid.y, grid.z], axis=1)[corners]
        normal = np.cross(b - a, c - a)
        distance = np.abs(ahead[near] * normal[:, 2])
        touches[near] = distance <= grid.thinnest * np.linalg.norm(normal, axis=1)
    return vertex, sign, ahead, touches


def _on_row(
    grid: _Grid, of: _Triangles, edge: Int[np.ndarray, "N"], y: Float[np.ndarray, "N"]
) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    part = (y - of.start_y[edge]) / of.rise[edge]
    z = grid.z[of.start[edge]]
    return of.start_x[edge] + part * of.run[edge], z + part * (grid.z[of.end[edge]] - z)
