"""Which parts of a posed body cross, exactly and slowly: `python -m benchmarks.oracles --out FILE`.

An edge that passes through a triangle is a self-intersection beyond doubt, and how far apart the
two are along the rest surface distinguishes a fold at a joint from a collision of body parts.
Nothing here uses rays: the crossings are ipctk's, the distances scipy's. How far apart is far
depends on where: of each pair of triangles the smaller of their two distances, which for trunk and
limbs are 0.3 m.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import ipctk
import jax
import numpy as np
import tyro
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from benchmarks.common import Table, progress
from spt_jax import BodyModel, load_body, load_mocap
from spt_jax.files.outputs import atomic_write

# The literature's distance between two ends of a fold (TUCH), and the issue's, for trunk and limbs.
FAR = 0.3


@dataclass(frozen=True)
class RestGraph:
    """Shortest ways along the edges of a mesh at rest.

    Rows of distances are computed when first asked for (5 ms each on a body of 12,272 vertices)
    and kept as float32: at most 600 MB on that body, should every vertex be asked for.

    Attributes:
        edges: vertex indices of each edge, once.
        beside: the triangles of each edge; of one with a single triangle, that one twice.
        allowed: for each triangle, how far apart it may be from what it only folds with.
        lengths: the edges as a symmetric sparse matrix, in the mesh's unit.
        rows: distances from a vertex to all vertices, by vertex.
    """

    edges: Int[np.ndarray, "E 2"]
    beside: Int[np.ndarray, "E 2"]
    allowed: Float[np.ndarray, "F"]
    lengths: csr_array
    rows: dict[int, Float[np.ndarray, "V"]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(
        cls,
        rest_vertices: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
        allowed: float | Float[np.ndarray, "F"] = FAR,
    ) -> "RestGraph":
        """The graph of a mesh; `of_body` is for bodies."""
        edges = edges_of(faces)
        length = np.linalg.norm(rest_vertices[edges[:, 0]] - rest_vertices[edges[:, 1]], axis=1)
        start, end = np.concatenate([edges, edges[:, ::-1]]).T
        shape = (len(rest_vertices), len(rest_vertices))
        lengths = csr_array((np.tile(length, 2), (start, end)), shape=shape)
        beside = _beside(edges, faces, len(rest_vertices))
        return cls(edges, beside, np.broadcast_to(allowed, len(faces)), lengths)

    @classmethod
    def of_body(cls, body: BodyModel) -> "RestGraph":
        """A body's, with its distances by place."""
        rest = np.asarray(body.template, np.float64), np.asarray(body.faces, np.int64)
        return cls.of(*rest, body.rest_surface.distances)

    def distances_from(self, vertices: Int[np.ndarray, "K"]) -> Float[np.ndarray, "K V"]:
        """Distances from each of the vertices to every vertex; infinity where no way leads."""
        new = [int(vertex) for vertex in np.unique(vertices) if int(vertex) not in self.rows]
        if new:
            found = dijkstra(self.lengths, directed=True, indices=new).astype(np.float32)
            self.rows.update(zip(new, found, strict=True))
        return np.stack([self.rows[int(vertex)] for vertex in vertices])


class FarCrossings(NamedTuple):
    """Edges that cross triangles, and how far apart those are at rest.

    Each triangle of an edge that crosses another triangle intersects that one; the farther of the
    two is meant here.

    Attributes:
        edge: index into the graph's edges, one a crossing.
        face: the triangle that it crosses.
        distance: the shortest way along the rest mesh's edges between corners of the triangles.
        allowed: the smaller of the two triangles' distances; a collision is no nearer.
    """

    edge: Int[np.ndarray, "N"]
    face: Int[np.ndarray, "N"]
    distance: Float[np.ndarray, "N"]
    allowed: Float[np.ndarray, "N"]

    @property
    def count(self) -> int:
        """Crossings in all, folds included."""
        return len(self.edge)

    @property
    def far(self) -> Bool[np.ndarray, "N"]:
        """Which are collisions."""
        return self.distance >= self.allowed

    @property
    def num_far(self) -> int:
        """How many are collisions."""
        return int(np.count_nonzero(self.far))

    @property
    def largest(self) -> float:
        """The largest distance; 0 without crossings."""
        return float(self.distance.max(initial=0.0))

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """(edge, triangle) of each collision."""
        return list(zip(self.edge[self.far].tolist(), self.face[self.far].tolist(), strict=True))


def _beside(edges, faces, count: int):
    """The two triangles of each edge."""
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1) @ [count, 1]
    order = np.argsort(ends, kind="stable")
    wanted = np.sort(edges, axis=1) @ [count, 1]
    low, high = (np.searchsorted(ends[order], wanted, side=side) for side in ("left", "right"))
    return order[np.stack([low, high - 1], axis=1)] // 3


def edges_of(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "E 2"]:
    """Every edge of the triangles, once."""
    return np.asarray(ipctk.edges(np.asarray(faces, np.int32)), np.int64)


def crossing_pairs(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    edges: Int[np.ndarray, "E 2"],
) -> Int[np.ndarray, "N 2"]:
    """(edge, triangle) of every edge that meets a triangle with which it shares no vertex.

    ipctk's boxes propose the pairs and its exact predicates decide; ipctk itself lists none. An
    edge that lies in its triangle's plane counts as meeting it.
    """
    vertices = np.asfortranarray(vertices, np.float64)
    boxes = ipctk.LBVH()  # a third of the time of ipctk's other broad phases
    boxes.build(vertices, np.asfortranarray(edges, np.int32), np.asfortranarray(faces, np.int32))
    found = []
    for candidate in boxes.detect_edge_face_candidates():
        edge, face = candidate.edge_id, candidate.face_id
        ends, corners = vertices[edges[edge]], vertices[faces[face]]
        if ipctk.is_edge_intersecting_triangle(*ends, *corners):
            found.append((edge, face))
    return np.array(sorted(found), np.int64).reshape(-1, 2)


def far_crossings(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], rest_graph: RestGraph
) -> FarCrossings:
    """Every edge-triangle crossing of a posed mesh with its distance along the rest mesh.

    Args:
        vertices: the posed mesh.
        faces: its triangles.
        rest_graph: of the same triangles at rest.

    Returns:
        FarCrossings, sorted by edge and triangle.
    """
    edge, face = crossing_pairs(vertices, faces, rest_graph.edges).T
    if not len(edge):
        return FarCrossings(edge, face, np.zeros(0, np.float32), np.zeros(0))
    beside = rest_graph.beside[edge]
    start, of_corner = np.unique(faces[beside], return_inverse=True)
    ways = rest_graph.distances_from(start)[
        of_corner.reshape(-1, 2, 3)[..., None], faces[face][:, None, None]
    ]
    distance = ways.min(axis=(2, 3))
    allowed = np.minimum(rest_graph.allowed[beside], rest_graph.allowed[face][:, None])
    farther = (distance - allowed).argmax(axis=1)[:, None]
    return FarCrossings(
        edge,
        face,
        np.take_along_axis(distance, farther, axis=1)[:, 0],
        np.take_along_axis(allowed, farther, axis=1)[:, 0],
    )


@dataclass
class Settings:
    """Where the scan of all mocap frames goes."""

    out: Path
    """An .npz file: name, num_crossings, largest_distance and num_far, one entry a frame."""


def main(settings: Settings) -> None:
    body, mocap = load_body(), load_mocap()
    faces = np.asarray(body.faces, np.int64)
    graph = RestGraph.of_body(body)
    posed = jax.jit(lambda pose: body(pose).vertices)
    figures = []
    with progress() as bar:
        for pose in bar.track(mocap.pose, description="crossing"):
            vertices = np.asarray(posed(body.pose_from_smpl(pose)), np.float64)
            found = far_crossings(vertices, faces, graph)
            figures.append((found.count, found.largest, found.num_far))
            if len(figures) % 50 == 0:
                print(f"{len(figures)} of {len(mocap.pose)} frames", flush=True)
    count, largest, num_far = np.array(figures).T
    with atomic_write(settings.out) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            name=np.array(mocap.names),
            num_crossings=count.astype(np.int64),
            largest_distance=largest,
            num_far=num_far.astype(np.int64),
        )
    motion = np.array([name.split("/")[0] for name in mocap.names])
    rows = []
    for title, chosen in [(m, motion == m) for m in np.unique(motion)] + [("all", motion != "")]:
        without, far = (count == 0) & chosen, (num_far > 0) & chosen
        kinds = (chosen, without, chosen & ~without & ~far, far)
        rows.append((title, *(str(np.count_nonzero(kind)) for kind in kinds)))
    Table(
        f"Edge-triangle crossings of the mocap frames; far: {FAR:g} m and more on trunk and limbs",
        ("motion", "frames", "none", "near ones only", "far ones"),
        rows,
    ).print()


if __name__ == "__main__":
    main(tyro.cli(Settings))
