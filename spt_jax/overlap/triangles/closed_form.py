r"""The overlap volume and its gradient in closed form, at any depth.

Each pair of solids that overlap in a place counts once there: with the winding number w,

    E = integral of w (w - 1) / 2,

which is 0 outside and inside one solid, 1 where two overlap or the surface is inside out, 3 where
three overlap. Crossing the surface inwards changes the integrand by c = w_out, so moving it with
velocity v changes E by the integral of w_out (v . n) over the surface. A triangle's share of the
gradient at its corner t is its normal times the integral of w_out lambda_t over it, and by Green's
theorem in barycentric coordinates (u, v), with dF/du = lambda_t,

    integral of w lambda_t du dv = sum over the triangle's sides of the integral of w F dv
                                 + sum over the contour's segments of (w_left - w_right) F dv.

For a triangle abc that another solid enters along the contour from s to e:

              c
             / \            Sides, w F dv:   a to b: w is 0 as far as e, where the side enters the
            / 0 s                            solid, then 1; b to c: 1 as far as s, then 0; c to a:
           /   / \                           0. Each side is taken from its corner's w, and each
          /   / 1 \                          place that it passes through adds its jump times the
         a---e-----b                         integral from there to the side's end (`_sides`).
                            Contour, F dv:   s to e, once, as w is 1 on its left, 0 on its right.

What is summed is the way around the part where w is 1: e to b to s to e. F is quadratic along a
straight line, so Simpson's rule is exact: no triangle is ever cut, however many sheets lie over
each other. The volume follows from the gradient, because it is homogeneous of degree three:
3 E = sum of (x_t - center) . grad_t E.

The same sums with constants in the place of F vanish on every triangle if corners, sides and
segments fit together; that they do is checked.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.arrays.vectors import area_normals, cross, dot, summed
from spt_jax.overlap.triangles.contours import Contours, senses
from spt_jax.overlap.triangles.pair_layout import Topology
from spt_jax.overlap.triangles.pairs import EdgeIntersections
from spt_jax.overlap.triangles.winding import Ends

# What the sums with constants, of sides of length one, may leave.
_GAP = 1e-6

_CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # (u, v) of a triangle's corners


@dataclass(frozen=True)
class Shares:
    """What each triangle contributes.

    Attributes:
        faces: the triangles whose surface lies in overlaps, wholly or in part.
        normals: of these, as long as twice the area.
        share: the integral of w_out lambda_t over each, in units of twice its area.
        sound: whether the sums of each triangle close.
    """

    faces: Int[np.ndarray, "H"]
    normals: Float[np.ndarray, "H 3"]
    share: Float[np.ndarray, "H 3"]
    sound: Bool[np.ndarray, "H"]

    def only(self, kept: Bool[np.ndarray, "H"]) -> "Shares":
        """Some of the triangles."""
        return Shares(*(value[kept] for value in vars(self).values()))

    @property
    def pull(self) -> Float[np.ndarray, "H 3 3"]:
        """The gradient's parts, by triangle and corner."""
        return self.share[:, :, None] * self.normals[:, None, :]


def shares_of(
    vertices: Float[np.ndarray, "V 3"],
    topology: Topology,
    intersections: EdgeIntersections,
    contours: Contours,
    ends: Ends,
    layer: int,
    times: Int[np.ndarray, "F"] | None = None,
) -> Shares:
    """Every triangle's part of the gradient of one layer's volume.

    Args:
        vertices: positions.
        topology: of the mesh.
        intersections, contours: those that are included on the layer.
        ends: the winding numbers.
        layer: which of them.
        times: how often each triangle is there, all copies in one place; once if not given. Of
            copies each next one lies one deeper than the last: what is returned is their mean.
    """
    faces = topology.faces
    within = ends.of_vertices()[:, layer] != 0
    if not len(contours.pair) and times is None and not within.any():
        nothing = np.zeros((0, 3))
        return Shares(np.zeros(0, np.int64), nothing, nothing, np.zeros(0, bool))
    a, b, c = (within.take(corner) for corner in faces.T)
    hot = a | b | c
    hot[contours.pair] = True
    if times is not None:
        hot |= times != 1
    found = np.flatnonzero(hot)
    row = np.full(len(faces), -1)
    row[found] = np.arange(len(found))
    corners = faces[found]
    normals = area_normals(vertices, corners)
    sums = _sides(topology, intersections, ends, layer, found, row, times)
    if len(contours.pair):
        # Once along the first triangle of each pair, and once the other way along the second.
        at = row[contours.pair.T.ravel()]
        start, end = _coordinates(
            vertices, topology, intersections, contours, corners[at], normals[at]
        )
        steps = _along(start, end)
        steps[len(contours.pair) :] *= -1.0
        if times is not None:
            steps *= times[contours.pair[:, ::-1].T.ravel(), None]
        sums += summed(at, steps, len(found))
    sound = np.abs(sums[:, 3:]).max(axis=1, initial=0.0) < _GAP
    sound[row[contours.pair[~contours.whole]]] = False
    share = sums[:, :3]
    if times is not None:
        share = share + of_copies(times[found])[:, None]
    return Shares(found, normals, share, sound)


def of_copies(times: Int[np.ndarray, "H"]) -> Float[np.ndarray, "H"]:
    """What copies of a triangle share with each other, at each corner, in the mean of them."""
    return (times - 1) / 12.0  # half of the integral of lambda


def _coordinates(vertices, topology, intersections, contours: Contours, corners, normals):
    """(u, v) of the segments' starts and ends, on the first triangles and then on the second ones.

    Args:
        corners, normals: of the first triangles of all pairs, then of the second ones.
    """
    a, b, c = (vertices[corner] for corner in corners.T)
    square = np.maximum(dot(normals, normals), np.finfo(float).tiny)[:, None]
    across_u, across_v = cross(c - a, normals) / square, cross(normals, b - a) / square
    cusp = np.tile(contours.cusp, 2)[:, None]
    found = np.empty((2, len(corners), 2))
    for k, at in enumerate(found):
        arm = np.tile(contours.point[:, k], (2, 1)) - a
        u = np.clip(dot(across_u, arm), 0.0, 1.0)
        v = np.clip(dot(across_v, arm), 0.0, 1.0)
        over = np.maximum(u + v, 1.0)
        at[:, 0], at[:, 1] = u / over, v / over
        # On its own side a place is known by the part of the edge, whatever the triangle's shape.
        number, owner = contours.end[:, k], contours.owner[:, k]
        passing = np.flatnonzero(number >= 0)
        mine = passing + owner[passing] * len(number)
        at[mine] = _on_sides(
            topology, contours.half[passing, k], intersections.part[number[passing]]
        )
        ending = np.flatnonzero(np.tile(number < 0, 2))
        at[ending] = _CORNERS[np.argmax(corners[ending] == cusp[ending], axis=1)]
    return found


def _on_sides(topology: Topology, half, part) -> Float[np.ndarray, "K 2"]:
    """(u, v) of places on half-edges, given what part of the edge lies before them."""
    part = np.where(senses(topology, half) > 0, part, 1 - part)
    turn = half % 3
    start, end = _CORNERS[(turn + 1) % 3], _CORNERS[(turn + 2) % 3]
    return start + part[:, None] * (end - start)


def _along(start, end) -> Float[np.ndarray, "K 5"]:
    """Integrals of F dv from start to end for the three corners, by Simpson's rule; du; dv."""
    u, v = np.stack([start, (start + end) / 2, end]).transpose(2, 0, 1)
    field = np.stack([u - u * u / 2 - u * v, u * u / 2, u * v], axis=2)
    step = end - start
    integrals = np.einsum("p,pkc->kc", [1 / 6, 4 / 6, 1 / 6], field) * step[:, 1, None]
    return np.concatenate([integrals, step], axis=1)


_SIDES = _along(_CORNERS, np.roll(_CORNERS, -1, axis=0))


def _sides(
    topology: Topology, intersections: EdgeIntersections, ends: Ends, layer, found, row, times
):
    """The sides' part of all sums."""
    corners = topology.faces[found]
    count = len(found)
    begins = ends.of_vertices()[:, layer][corners].astype(np.float64)
    cusped = np.flatnonzero(ends.cusp[corners])
    if len(cusped):
        face, turn = np.divmod(cusped, 3)
        there = topology.row[3 * found[face] + (turn + 2) % 3]
        end = (topology.ends[there, 1] == corners[face, turn]).astype(np.int64)
        begins[face, turn] = ends.of_ends(topology, there, end)[:, layer]
    sums = begins @ _SIDES

    number, half = sides_of(topology, intersections)
    jump = intersections.jump[number] * senses(topology, half)
    if times is not None:
        jump = jump * times[intersections.face[number]]
    at = _on_sides(topology, half, intersections.part[number])
    rest = _along(at, _CORNERS[(half % 3 + 2) % 3])
    return sums + summed(row[half // 3], jump[:, None] * rest, count)


def sides_of(
    topology: Topology, intersections: EdgeIntersections
) -> tuple[Int[np.ndarray, "N"], Int[np.ndarray, "N"]]:
    """Each edge that passes through a triangle is a side of two others: crossing, half-edge."""
    number = np.tile(np.arange(len(intersections.face)), 2)
    half = topology.halves[intersections.row].T.ravel()
    kept = np.flatnonzero(half >= 0)
    return number[kept], half[kept]


def volumes_of(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    shares: Shares,
    region: Int[np.ndarray, "H"],
    count: int,
    times: Int[np.ndarray, "F"] | None = None,
) -> Float[np.ndarray, "R"]:
    """The volume of each region, from the gradients of its triangles.

    Args:
        vertices, faces: the mesh.
        shares: what the triangles contribute.
        region: of each of these triangles, from 0 to `count` - 1.
        count: how many regions there are.
        times: how often each triangle is there.
    """
    points = vertices[faces[shares.faces]]
    size = np.maximum(np.bincount(region, minlength=count), 1)
    center = summed(region, points.mean(axis=1), count) / size[:, None]
    arm = points - center[region][:, None, :]
    parts = np.einsum("kci,kci->k", arm, shares.pull)
    if times is not None:
        parts *= times[shares.faces]
    return np.bincount(region, parts, count) / 3


def gradient_of(
    faces: Int[np.ndarray, "F 3"],
    shares: Shares,
    weight: Float[np.ndarray, "H"] | None,
    count: int,
) -> Float[np.ndarray, "V 3"]:
    """The sum of the triangles' gradients, each with a weight, at `count` vertices."""
    pull = shares.pull if weight is None else weight[:, None, None] * shares.pull
    return summed(faces[shares.faces].ravel(), pull.reshape(-1, 3), count)
