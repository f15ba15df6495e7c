"""A surface's vertices as a graph: who is near whom, and forces spread into smooth displacements.

NumPy and SciPy only. All lengths are counted in edges, so that a mesh's fine parts (fingers) and
coarse parts (trunk) are treated alike, and so that a Laplacian of bad triangles stays well
conditioned. `newton_step` and `sized_step` scale the displacements of several regions at once.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int, Shaped

from spt_jax.overlap.arrays.vectors import cross, dot, summed
from spt_jax.overlap.topology import connected


class Surface:
    """What of a closed mesh depends on its faces alone; made once for many sets of vertices.

    Attributes:
        faces: without those that list a vertex twice; they have no area.
        num_vertices: of the mesh.
        neighbors: (V, V) sparse matrix of ones where two vertices share an edge.
        laplacian: (V, V), the graph's: degree minus neighbors.
    """

    def __init__(self, faces: Int[np.ndarray, "F 3"], num_vertices: int):
        faces = faces.astype(np.int64)
        degenerate = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
        self.faces = faces[~degenerate]
        self.num_vertices = num_vertices
        tail, head = self.faces.ravel(), np.roll(self.faces, -1, axis=1).ravel()
        links = scipy.sparse.coo_matrix(
            (np.ones(2 * len(tail)), (np.r_[tail, head], np.r_[head, tail])),
            (num_vertices, num_vertices),
        ).tocsr()
        links.data[:] = 1.0
        self.neighbors: Any = links
        self.laplacian: Any = scipy.sparse.diags(np.asarray(links.sum(axis=1)).ravel()) - links

    @cached_property
    def part(self) -> Int[np.ndarray, "V"]:
        """The connected part of each vertex, numbered from 0."""
        return scipy.sparse.csgraph.connected_components(self.neighbors, directed=False)[1]

    @cached_property
    def num_parts(self) -> int:
        """How many connected parts there are; a vertex of no triangle is one."""
        return int(self.part.max(initial=-1)) + 1

    def part_sums(self, values: Shaped[np.ndarray, "F"]) -> Float[np.ndarray, "N"]:
        """The sum over the faces of each connected part."""
        return np.bincount(self.part[self.faces[:, 0]], values, self.num_parts)

    def part_senses(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "N"]:
        """-1 for each connected part that is inside out, else +1; 0 for one without volume."""
        count = np.maximum(np.bincount(self.part, minlength=self.num_parts), 1)
        middle = summed(self.part, vertices, self.num_parts) / count[:, None]
        a, b, c = (vertices - middle[self.part])[self.faces].transpose(1, 0, 2)
        each = dot(a, cross(b, c))
        volume, rounding = self.part_sums(each), 1e-12 * self.part_sums(np.abs(each))
        return np.where(np.abs(volume) > rounding, np.sign(volume), 0.0)

    def part_boxes(
        self, vertices: Float[np.ndarray, "V 3"]
    ) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
        """The lowest and the highest corner of the box around each connected part."""
        low, high = np.full((2, self.num_parts, 3), np.inf)
        np.minimum.at(low, self.part, vertices)
        np.minimum.at(high, self.part, -vertices)
        return low, -high

    def part_sizes(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "N"]:
        """The diagonal of the box around each connected part."""
        low, high = self.part_boxes(vertices)
        return np.linalg.norm(high - low, axis=1)

    def farthest(self, shift: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "N"]:
        """The largest displacement in each connected part."""
        far = np.zeros(self.num_parts)
        np.maximum.at(far, self.part, np.linalg.norm(shift, axis=1))
        return far

    def within(self, start: Int[np.ndarray, "M"], most: int) -> Int[np.ndarray, "_"]:
        """Vertices at most so many edges away from those of `start`, themselves included."""
        reached = np.zeros(self.num_vertices, bool)
        reached[start] = True
        front = start
        for _ in range(most):
            near = np.unique(self.neighbors[front].indices)
            front = near[~reached[near]]
            if not len(front):
                break
            reached[front] = True
        return np.flatnonzero(reached)

    def groups(
        self, used: Bool[np.ndarray, "V"], first: Int[np.ndarray, "K"], second: Int[np.ndarray, "K"]
    ) -> list[Int[np.ndarray, "_"]]:
        """The used vertices in groups that hang together by edges or by links first to second."""
        members = np.flatnonzero(used)
        if not len(members):
            return []
        place = np.full(self.num_vertices, -1)
        place[members] = np.arange(len(members))
        edges = self.neighbors[members][:, members].tocoo()
        label = connected(
            np.concatenate([edges.row, place[first]]),
            np.concatenate([edges.col, place[second]]),
            len(members),
        )
        order = np.argsort(label, kind="stable")
        _, start = np.unique(label[order], return_index=True)
        return [members[part] for part in np.split(order, start[1:])]

    def edge_length(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V"]:
        """The mean length of the edges at each vertex; zero where there are none."""
        graph = self.neighbors
        row = np.repeat(np.arange(self.num_vertices), np.diff(graph.indptr))
        length = np.linalg.norm(vertices[row] - vertices[graph.indices], axis=1)
        total = np.bincount(row, length, self.num_vertices)
        return total / np.maximum(np.diff(graph.indptr), 1)


@dataclass(frozen=True)
class Spread:
    """Forces on some vertices, spread over a patch of the surface: K u = f.

    K = 1 + (s^2 L / 6)^2, with L the graph's Laplacian and s, in edges, how far a force reaches:
    the thin-plate energy of the displacement (Botsch and Sorkine 2008, "On linear variational
    surface deformation methods", section 3), next to its plain square. Outside of the patch
    nothing moves.

    Attributes:
        surface: the mesh's graph.
        reach: s of every vertex; zero outside of the patch.
    """

    surface: Surface
    reach: Float[np.ndarray, "V"]

    @cached_property
    def patch(self) -> Int[np.ndarray, "P"]:
        """The vertices that may move."""
        return np.flatnonzero(self.reach > 0)

    @cached_property
    def _factor(self) -> Any:
        inside = self.patch
        # All rows of L that a vertex of the patch takes part in, so that the displacement goes to
        # zero smoothly: at the patch's boundary its Laplacian is included.
        bend = scipy.sparse.diags(self.reach**2 / 6.0) @ self.surface.laplacian[:, inside]
        form = scipy.sparse.identity(len(inside)) + bend.T @ bend
        # Symmetric and positive definite: no pivoting, which would fill the factors in.
        return scipy.sparse.linalg.splu(
            form.tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

    def __call__(self, forces: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """The displacement of every vertex."""
        moved = np.zeros(forces.shape)
        if len(self.patch):
            moved[self.patch] = self._factor.solve(np.ascontiguousarray(forces[self.patch]))
        return moved


def newton_step(
    spread: Spread, push: Float[np.ndarray, "V 3"], regions: list[tuple[np.ndarray, float]]
) -> Float[np.ndarray, "V 3"]:
    """The smallest displacement, in the sense of `spread`, that takes so much volume away."""
    forces = np.zeros(push.shape)
    if not regions:
        return forces
    size = {}
    for k, (members, _) in enumerate(regions):
        size[k] = np.linalg.norm(push[members])
        forces[members] = push[members] / size[k]
    moved = spread(forces)
    for k, (members, volume) in enumerate(regions):
        gain = size[k] * np.sum(forces[members] * moved[members])
        forces[members] *= -volume / gain if gain > 0 else 0.0
    return spread(forces)


def sized_step(
    spread: Spread, pull: Float[np.ndarray, "V 3"], regions: list[tuple[np.ndarray, float]]
) -> Float[np.ndarray, "V 3"]:
    """A displacement along the forces, as large as asked for in each region."""
    forces = np.zeros(pull.shape)
    if not regions:
        return forces
    for members, _ in regions:
        forces[members] = pull[members]
    moved = spread(forces)
    for members, size in regions:
        largest = np.linalg.norm(moved[members], axis=1).max()
        forces[members] *= size / largest if largest > 0 else 0.0
    return spread(forces)
