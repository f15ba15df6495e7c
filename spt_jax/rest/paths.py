"""Shortest paths along the edges of a mesh, tabulated from seeds; NumPy and SciPy only."""

import functools
import hashlib
import threading

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

# Every piece of the mesh gets a seed.
MOST_PIECES = 512
# 512 seeds leave no triangle of the embedded body farther than 48 mm from one (18 mm on average).
_SEEDS = 512
# Entries of the table, 4 bytes each: meshes above 131,000 triangles get fewer seeds instead.
_LARGEST_TABLE = 1 << 26
# Bytes kept of what shortest paths have answered; a face's answer takes one bit per face.
_MOST_ANSWERS = 64 << 20
# Sparse graphs take an entry of zero for no edge.
_NO_LENGTH = np.finfo(float).tiny


def surface_paths(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> "SurfacePaths":
    """The shortest paths of a mesh; equal meshes share one object."""
    return _shared(_Content(vertices, faces))


@functools.lru_cache(maxsize=4)
def _shared(content: "_Content") -> "SurfacePaths":
    return SurfacePaths(content)


class _Content:
    """A mesh, hashed and compared by its bytes."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]):
        self.vertices, self.faces = vertices, faces
        size = f"{len(vertices)} {len(faces)} ".encode()
        data = size + vertices.tobytes() + faces.tobytes()
        self._digest = hashlib.blake2b(data, digest_size=32).digest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Content) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)


class SurfacePaths:
    """Shortest paths along the edges of one mesh, between the nearest corners of its triangles.

    A path that a third place splits bounds them from both sides, as for points, but for one thing:
    it may reach a triangle at one corner and go on from another. A triangle's longest edge bounds
    what that hides.

    Attributes:
        content: the mesh.
        faces: its triangles.
        graph: the lengths of its edges, symmetric.
        pieces: how many parts without a common vertex they make.
    """

    def __init__(self, content: _Content):
        self.content = content
        self.faces = content.faces
        corners = content.vertices[self.faces]
        edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        self._longest = edges.max(axis=1, initial=0.0).astype(np.float32)
        self.graph = _edge_graph(content.vertices, self.faces)
        labels = scipy.sparse.csgraph.connected_components(self.graph, directed=False)[1]
        self.pieces = len(np.unique(labels[self.faces[:, 0]]))
        self._lock = threading.Lock()
        self._table: _Table | None = None
        self._answers: dict[tuple[float, int], np.ndarray] = {}

    @property
    def slack(self) -> float:
        """What rounding to float32 can move a distance by, and twice as much again."""
        return 8 * float(np.finfo(np.float32).eps) * self.table.extent

    def bounds(
        self, f: Int[np.ndarray, "N"], g: Int[np.ndarray, "N"]
    ) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
        """From below and above, by the paths over the seed nearest to each."""
        table = self.table
        over_g = table.flat.take(f * table.seeds + table.nearest.take(g))
        over_f = table.flat.take(g * table.seeds + table.nearest.take(f))
        upper = np.minimum(over_g + table.to_nearest.take(g), over_f + table.to_nearest.take(f))
        over_g -= table.from_nearest.take(g)
        over_f -= table.from_nearest.take(f)
        lower = np.maximum(over_g, over_f, out=over_g)
        return np.maximum(lower, np.float32(0), out=lower), upper

    def near(
        self, f: Int[np.ndarray, "N"], g: Int[np.ndarray, "N"], distance: float
    ) -> Bool[np.ndarray, "N"]:
        """Whether pairs of one connected part are nearer, for the few that `bounds` leaves open."""
        table = self.table
        near = np.zeros(len(f), bool)
        undecided = []
        for start in range(0, len(f), 2048):  # 4 MB a side
            part = slice(start, start + 2048)
            to_f, to_g = table.rows[f[part]], table.rows[g[part]]
            near[part] = (to_f + to_g).min(axis=1) < distance - self.slack
            with np.errstate(invalid="ignore"):
                to_f -= to_g  # NaN, inf - inf, at seeds of other parts: fmax leaves it out
            farther_f = np.fmax.reduce(to_f, axis=1) - self._longest[g[part]]
            farther_g = -np.fmin.reduce(to_f, axis=1) - self._longest[f[part]]
            lower = np.maximum(farther_f, farther_g)
            undecided.append(start + np.flatnonzero(~near[part] & (lower < distance + self.slack)))
        rest = np.concatenate(undecided) if undecided else np.zeros(0, int)
        if len(rest):
            near[rest] = self._answer(f[rest], g[rest], distance)
        return near

    def _answer(self, f, g, distance):
        sources = np.unique(f)
        with self._lock:
            new = [s for s in sources.tolist() if (distance, s) not in self._answers]
            bytes_each = -(-len(self.faces) // 8)
            if (len(self._answers) + len(new)) * bytes_each > _MOST_ANSWERS:
                self._answers.clear()
                new = sources.tolist()
            for start in range(0, len(new), 64):
                part = new[start : start + 64]
                for source, row in zip(part, self._from_faces(part, distance), strict=True):
                    self._answers[distance, source] = np.packbits(row < distance)
            rows = [self._answers[distance, s] for s in sources.tolist()]
        byte = np.stack(rows)[np.searchsorted(sources, f), g >> 3]
        return (byte >> (7 - (g & 7))) & 1 == 1

    def _from_faces(self, sources, limit):
        """Distances from a few faces to all; infinite beyond the limit."""
        graph = self.graph
        # Each source is a node behind the vertices, with ways out to its corners and none in.
        ways = graph.nnz + 3 * np.arange(1, len(sources) + 1)
        vertices = len(self.content.vertices)
        size = vertices + len(sources)
        with_sources = scipy.sparse.csr_array(
            (
                np.concatenate([graph.data, np.full(3 * len(sources), _NO_LENGTH)]),
                np.concatenate([graph.indices, self.faces[sources].ravel()]),
                np.concatenate([graph.indptr, ways]),
            ),
            shape=(size, size),
        )
        to_vertices = scipy.sparse.csgraph.dijkstra(
            with_sources, indices=np.arange(vertices, size), limit=limit
        )
        return _to_faces(np.ascontiguousarray(to_vertices.T), self.faces).T

    @property
    def table(self) -> "_Table":
        """Distances from the seeds, made when they are first asked for."""
        table = self._table
        if table is None:
            with self._lock:
                table = self._table = self._table or _Table(
                    self.graph, self.faces, self._longest, self.pieces
                )
        return table


class _Table:
    """Distances from the seeds to all faces, and each face's nearest seed."""

    def __init__(self, graph, faces, longest, pieces):
        used = np.unique(faces)
        most = min(_SEEDS, len(used), max(_LARGEST_TABLE // max(len(faces), 1), pieces))
        rows, nearest = [], np.full(len(used), np.inf)
        while len(rows) < most and nearest.max() > 0:
            rows.append(scipy.sparse.csgraph.dijkstra(graph, indices=used[nearest.argmax()]))
            nearest = np.minimum(nearest, rows[-1][used])
        to_vertices = np.array(rows, np.float32).reshape(len(rows), graph.shape[0]).T
        self.rows = _to_faces(np.ascontiguousarray(to_vertices), faces)
        self.flat = self.rows.reshape(-1)
        self.seeds = self.rows.shape[1]
        if len(faces):
            self.nearest = self.rows.argmin(axis=1)
            self.to_nearest = self.rows.min(axis=1)
            self.extent = float(self.rows.max(initial=0.0, where=np.isfinite(self.rows)))
        else:
            self.nearest, self.to_nearest, self.extent = np.zeros(0, int), np.zeros(0, "f4"), 0.0
        # At most so far is the nearest seed from whichever corner.
        self.from_nearest = self.to_nearest + longest


def _to_faces(to_vertices, faces):
    """(F, S) from (V, S): the shortest way to a face, to any of its corners."""
    best = to_vertices[faces[:, 0]]
    for corner in (1, 2):
        np.minimum(best, to_vertices[faces[:, corner]], out=best)
    return best


def _edge_graph(vertices, faces) -> "scipy.sparse.csr_array":
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = np.unique(np.sort(ends, axis=1), axis=0)
    length = np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1)
    length = np.maximum(length, _NO_LENGTH)
    rows, columns = np.concatenate([ends, ends[:, ::-1]]).T
    shape = (len(vertices), len(vertices))
    return scipy.sparse.csr_array(
        scipy.sparse.coo_array((np.tile(length, 2), (rows, columns)), shape=shape)
    )
