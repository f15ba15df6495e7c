"""The hardest algorithms again, slow and readable: loops over Python's numbers, exact signs.

They hold for closed surfaces in general position, whose triangles meet others but not those with
which they share a vertex: no cusps.
"""

import itertools
from collections import defaultdict
from collections.abc import Iterable, Sequence
from fractions import Fraction

import numpy as np
from helpers import Mesh

Edge = tuple[int, int]
Hit = tuple[float, int, int]


def volume(a, b, c, d) -> Fraction:
    """Six times the volume of a tetrahedron, exactly; positive where d sees abc clockwise."""
    a, b, c, d = ([Fraction(float(x)) for x in point] for point in (a, b, c, d))
    u, v, w = ([point[k] - a[k] for k in range(3)] for point in (b, c, d))
    found = (
        u[0] * (v[1] * w[2] - v[2] * w[1])
        - u[1] * (v[0] * w[2] - v[2] * w[0])
        + u[2] * (v[0] * w[1] - v[1] * w[0])
    )
    assert found != 0, "not in general position"
    return found


def passes(start, end, corners) -> tuple[int, float] | None:
    """How the winding number changes from start to end where a triangle lies between, and where.

    +1 where the solid that the triangle bounds is entered, so that the end lies behind the
    triangle; the second number is the part of the way.
    """
    a, b, c = corners
    before, after = volume(a, b, c, start), volume(a, b, c, end)
    if (before > 0) == (after > 0):
        return None
    if len({volume(start, end, *side) > 0 for side in ((a, b), (b, c), (c, a))}) > 1:
        return None
    return (1 if before > 0 else -1), float(before / (before - after))


def edges_of(faces) -> list[Edge]:
    sides = itertools.chain.from_iterable(((a, b), (b, c), (c, a)) for a, b, c in faces.tolist())
    return sorted({(min(side), max(side)) for side in sides})


def crossings(mesh: Mesh) -> dict[Edge, list[Hit]]:
    """Of each edge, from its lower vertex on, what it passes through: where, jump, triangle."""
    vertices, faces = mesh
    found = defaultdict(list)
    for p, q in edges_of(faces):
        for face, corners in enumerate(faces.tolist()):
            if p in corners or q in corners or not _boxes_meet(vertices[[p, q]], vertices[corners]):
                continue
            hit = passes(vertices[p], vertices[q], vertices[corners])
            if hit:
                found[p, q].append((hit[1], hit[0], face))
    return {edge: sorted(hits) for edge, hits in found.items()}


def _boxes_meet(one, other) -> bool:
    low, high = np.maximum(one.min(axis=0), other.min(axis=0)), np.minimum(one.max(0), other.max(0))
    return bool((low <= high).all())


# The winding number: `triangles/winding.py`.


def winding_numbers(mesh: Mesh) -> list[int]:
    """The number just outside the surface at each vertex, from one vertex of each part."""
    vertices, faces = mesh
    jumps = {edge: sum(jump for _, jump, _ in hits) for edge, hits in crossings(mesh).items()}
    neighbors = defaultdict(list)
    for p, q in edges_of(faces):
        neighbors[p].append((q, jumps.get((p, q), 0)))
        neighbors[q].append((p, -jumps.get((p, q), 0)))
    winding: dict[int, int] = {}
    for root in sorted(neighbors, key=lambda vertex: -vertices[vertex, 0]):
        if root not in winding:  # else of a part that is known already
            winding[root] = _at_root(mesh, root, _part_of(root, neighbors))
            waiting = [root]
            while waiting:
                here = waiting.pop()
                for there, jump in neighbors[here]:
                    if there not in winding:
                        winding[there] = winding[here] + jump
                        waiting.append(there)
                    assert winding[there] == winding[here] + jump, "two ways do not agree"
    return [winding[vertex] for vertex in range(len(vertices))]


def _part_of(root: int, neighbors: dict[int, list[tuple[int, int]]]) -> set[int]:
    part, waiting = {root}, [root]
    while waiting:
        new = {there for there, _ in neighbors[waiting.pop()]} - part
        part |= new
        waiting += new
    return part


def _at_root(mesh: Mesh, root: int, part: set[int]) -> int:
    """At the vertex of a part that is farthest along x: its own solid, and all others there."""
    vertices, faces = mesh
    own = [corners for corners in faces.tolist() if corners[0] in part]
    others = [corners for corners in faces.tolist() if corners[0] not in part]
    rng = np.random.default_rng(root)
    number = 0
    while number == 0:  # a place beside the vertex that is not outside
        number = number_at(vertices, own, vertices[root] + 1e-6 * rng.normal(size=3))
    return (0 if number > 0 else -1) + number_at(vertices, others, vertices[root])


def number_at(vertices, faces: Iterable[Sequence[int]], point) -> int:
    """The winding number at a point: what is lost on the way to a place outside of everything."""
    far = point + np.ptp(vertices, axis=0).max() * np.array([9.0, 0.0123, 0.0217])
    hits = (passes(point, far, vertices[list(corners)]) for corners in faces)
    return -sum(hit[0] for hit in hits if hit)


# The broad phase: `triangles/pair_boxes.py`, and its clusters: `triangles/pair_layout.py`.


def near_pairs(mesh: Mesh, slack: float = 0.0) -> set[frozenset[int]]:
    """Pairs of triangles that share no vertex and whose boxes meet, or come nearer than slack."""
    vertices, faces = mesh
    low, high = vertices[faces].min(axis=1) - slack, vertices[faces].max(axis=1)
    return {
        frozenset((f, g))
        for f, g in itertools.combinations(range(len(faces)), 2)
        if not set(faces[f]) & set(faces[g])
        and (low[f] <= high[g]).all()
        and (low[g] <= high[f]).all()
    }


def clusters(centers: np.ndarray, some: Sequence[int], size: int) -> list[list[int]]:
    """Triangles in clusters: halved along the axis in which their centers are spread widest."""
    some = list(some)
    if len(some) <= size:
        return [some]
    axis = np.ptp(centers[some], axis=0).argmax()
    some = sorted(some, key=lambda face: centers[face, axis])
    unit = size**2 if len(some) > size**2 else size  # whole groups first, then whole clusters
    units = -(-len(some) // unit)
    left = unit * -(-units // 2)
    return clusters(centers, some[:left], size) + clusters(centers, some[left:], size)


# The contours: `triangles/contours.py`.


def contours(mesh: Mesh) -> dict[Edge, np.ndarray]:
    """Of each pair of triangles that intersect, the lower first, where their segment runs."""
    vertices, faces = mesh
    ends = defaultdict(list)
    for (p, q), hits in crossings(mesh).items():
        beside = [face for face, corners in enumerate(faces.tolist()) if {p, q} <= set(corners)]
        for part, _, face in hits:
            for other in beside:
                ends[min(face, other), max(face, other)].append(
                    vertices[p] + part * (vertices[q] - vertices[p])
                )
    found = {}
    for (f, g), (start, end) in ends.items():
        one, other = (np.cross(b - a, c - a) for a, b, c in vertices[faces[[f, g]]])
        backwards = np.dot(end - start, np.cross(one, other)) < 0
        found[f, g] = np.array([end, start] if backwards else [start, end])
    return found


# The closed form: `triangles/closed_form.py`.


def shares(mesh: Mesh) -> dict[int, np.ndarray]:
    """The integral of w_out lambda_t over each triangle, in units of twice its area.

    By the way around every region of it: along its sides, piece by piece between the places that
    they pass through, and along the contours.
    """
    vertices, faces = mesh
    winding, hits = winding_numbers(mesh), crossings(mesh)
    segments = contours(mesh)
    found = {}
    for face, corners in enumerate(faces.tolist()):
        total = np.zeros(3)
        places = np.eye(3)  # the corners, in barycentric coordinates
        for k in range(3):
            p, q = corners[k], corners[(k + 1) % 3]
            number, here = winding[p], 0.0
            for part, jump in _along(hits, p, q):
                total += number * _way(places, k, here, part)
                number, here = number + jump, part
            assert number == winding[q]
            total += number * _way(places, k, here, 1.0)
        for pair, (start, end) in segments.items():
            if face in pair:
                sign = 1 if face == pair[0] else -1
                ends = (_barycentric(vertices[corners], point) for point in (start, end))
                total += sign * _integral(*ends)
        found[face] = total
    return found


def _along(hits: dict[Edge, list[Hit]], p: int, q: int) -> list[tuple[float, int]]:
    """The places at which a side passes through something, in order from p to q."""
    if p < q:
        return [(part, jump) for part, jump, _ in hits.get((p, q), [])]
    return [(1 - part, -jump) for part, jump, _ in reversed(hits.get((q, p), []))]


def _way(places, k: int, begin: float, end: float) -> np.ndarray:
    first, second = places[k], places[(k + 1) % 3]
    return _integral(*(first + part * (second - first) for part in (begin, end)))


def _integral(start, end) -> np.ndarray:
    """The integral of F dv along a straight line, where dF/du is each barycentric coordinate.

    u and v are the second and the third of them.
    """

    def antiderivatives(at):
        _, u, v = at
        return np.array([u - u * u / 2 - u * v, u * u / 2, u * v])

    middle = (start + end) / 2
    mean = (antiderivatives(start) + 4 * antiderivatives(middle) + antiderivatives(end)) / 6
    return mean * (end[2] - start[2])


def _barycentric(corners, point) -> np.ndarray:
    return np.linalg.lstsq(np.vstack([corners.T, np.ones(3)]), np.append(point, 1.0))[0]


# The tables of rest surfaces: `xla/tables.py`.


def distances_at_rest(vertices, faces) -> np.ndarray:
    """Between every two triangles, the shortest path along edges from any corner to any."""
    count = len(vertices)
    along = np.full((count, count), np.inf)
    np.fill_diagonal(along, 0.0)
    for p, q in edges_of(faces):
        along[p, q] = along[q, p] = np.linalg.norm(vertices[p] - vertices[q])
    for middle in range(count):  # Floyd and Warshall
        along = np.minimum(along, along[:, middle, None] + along[middle])
    return np.array(
        [[along[np.ix_(one, other)].min() for other in faces.tolist()] for one in faces.tolist()]
    )
