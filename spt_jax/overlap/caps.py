"""Holes, and the fans that close them.

A loop of boundary edges is closed by triangles to the mean of its vertices (`manifold.py`). Those
are linear in the mesh's vertices, so volume and gradient are exact through them. What such a fan
stands for is not there, though: a hand ends at the wrist, a mouth is open. So two rules.

A loop is a hole of a solid only if what closes it is small beside the surface around. With L the
length of the loop and A the area of the connected part, its size is L^2 / (4 pi A): the largest
flat disk with that perimeter, against the part. It does not change when a surface bends without
stretching. No flat sheet has less than 1, a hemisphere has 1/2 (2/3 with a rim of teeth), a tube
as long as it is wide 1/4 at each end, a hand at the wrist less than 1/10. Beyond `LARGEST` the part
is a sheet, without an inside.

And a fan that meets the surface beside its own hole is a fold, whatever else counts: a curved
loop's fan cuts through the lips. What lies within a loop's diameter of it, counted in edges, is
beside it.
"""

import functools
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.arrays.vectors import area_normals, dot
from spt_jax.overlap.triangles.manifold import Manifold

LARGEST = 0.75
"""The size, L^2 / (4 pi A), up to which a loop is closed."""


class Hole(NamedTuple):
    """A boundary loop.

    Attributes:
        edges: how many it has.
        length: of all of them, in the vertices' unit.
        size: L^2 / (4 pi A), with A the area of the connected part that it belongs to.
        part: the number of that part (`Manifold.part`).
    """

    edges: int
    length: float
    size: float
    part: int

    @property
    def is_closed(self) -> bool:
        """Whether a fan closes it; else its part is an open sheet."""
        return self.size <= LARGEST


def holes_of(manifold: Manifold, vertices: Float[np.ndarray, "V 3"]) -> list[Hole]:
    """Every boundary loop of a surface.

    Args:
        manifold: the surface, rewritten.
        vertices: those given.
    """
    if not manifold.num_fans:
        return []
    own, first = np.unique(manifold.kept, return_index=True)
    own, first = own[own >= 0], first[own >= 0]
    normals = area_normals(vertices, manifold.given[own])
    part = manifold.part[manifold.faces[first, 0]]
    area = 0.5 * np.bincount(part, np.sqrt(dot(normals, normals)), manifold.num_parts)
    found = []
    for k in range(manifold.num_fans):
        loop = manifold.loops[k]
        length = float(np.linalg.norm(vertices[loop] - vertices[np.roll(loop, 1)], axis=1).sum())
        around = int(manifold.part[len(manifold.origin) + k])
        room = 4 * np.pi * float(area[around])
        size = length**2 / room if room > 0 else np.inf if length > 0 else 0.0
        found.append(Hole(len(loop), length, size, around))
    return found


def open_sheets(manifold: Manifold, vertices: Float[np.ndarray, "V 3"]) -> str | None:
    """Why a surface has no inside, or None where all of its holes are closed."""
    holes = [hole for hole in holes_of(manifold, vertices) if not hole.is_closed]
    if not holes:
        return None
    worst = max(holes, key=lambda hole: hole.size)
    parts = len({hole.part for hole in holes})
    what = "a connected part is an open sheet" if parts == 1 else f"{parts} parts are open sheets"
    return (
        f"mesh must have no hole that is too large to be closed: got a loop of {worst.edges} "
        f"edges and length {worst.length:.3g}, around {worst.size:.2f} of its part's area, where "
        f"up to {LARGEST:g} is closed; {what}, which encloses nothing. With solids beside it, "
        "sheet_penalty measures what lies in them; else thicken it, or close it."
    )


def holes_in_words(count: int, largest: Hole, unit: str = "") -> str:
    """How many holes there are, and how large the largest of them is."""
    length = f"{largest.length:.3g}{' ' if unit else ''}{unit}"
    many = "1 hole" if count == 1 else f"{count} holes, the largest"
    return f"{many} of {largest.edges} edges, {length} long, {largest.size:.1%} of its part"


def beside_caps(
    manifold: Manifold, f: Int[np.ndarray, "N"], g: Int[np.ndarray, "N"]
) -> Bool[np.ndarray, "N"]:
    """Pairs of the rewritten faces, one of which is a fan and the other beside its hole."""
    fan, near = _neighborhoods(manifold)
    found = np.zeros(len(f), bool)
    for one, other in ((f, g), (g, f)):
        at = np.flatnonzero(fan[one] >= 0)
        corners = manifold.faces[other[at]]
        key = fan[one[at], None] * len(manifold.part) + corners
        found[at] |= np.isin(key, near).any(axis=1)
    return found


@functools.lru_cache(maxsize=8)
def _neighborhoods(manifold: Manifold) -> tuple[Int[np.ndarray, "G"], Int[np.ndarray, "N"]]:
    """The fan of each face, -1 for none; and fan * vertices + vertex of what is beside each."""
    center = len(manifold.origin)
    hub = manifold.faces - center
    fan = np.where((hub >= 0) & (hub < manifold.num_fans), hub, -1).max(axis=1, initial=-1)
    count = len(manifold.part)
    links = np.concatenate([manifold.faces[:, :2], manifold.faces[:, 1:]])
    links = links[(links < center).all(axis=1)]
    graph = scipy.sparse.coo_array((np.ones(len(links), np.int8), tuple(links.T)), (count, count))
    graph = (graph + graph.T).tocsr()
    keys = []
    for k in range(manifold.num_fans):
        rim = np.unique(manifold.faces[fan == k])
        reached = np.zeros(count, bool)
        reached[rim] = True
        front = rim[rim < center]
        for _ in range(int(np.ceil(len(front) / np.pi))):
            near = np.unique(graph[front].indices)
            front = near[~reached[near]]
            reached[front] = True
        keys.append(k * count + np.flatnonzero(reached))
    return fan, np.concatenate(keys) if keys else np.zeros(0, np.int64)


class Closed(NamedTuple):
    """A surface with the fans in place of its holes, its own vertices and faces first.

    Attributes:
        vertices: and the fans' centers behind them.
        faces: and the fans behind them.
        beside: of each face the face given that it is, or at the edge of which it lies.
    """

    vertices: Float[np.ndarray, "W 3"]
    faces: Int[np.ndarray, "G 3"]
    beside: Int[np.ndarray, "G"]


def closed_surface(
    manifold: Manifold, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Closed:
    """The surface with its holes closed; what was given where there are none."""
    if not manifold.num_fans:
        return Closed(vertices, faces, np.arange(len(faces)))
    centers = [vertices[manifold.loops[k]].mean(axis=0) for k in range(manifold.num_fans)]
    fans = np.flatnonzero(manifold.kept < 0)
    corners = manifold.faces[fans]
    number = np.append(manifold.origin, len(vertices) + np.arange(len(manifold.loops)))
    return Closed(
        np.concatenate([vertices, centers]),
        np.concatenate([faces, number[corners]]),
        np.concatenate([np.arange(len(faces)), manifold.beside[fans]]),
    )
