"""A bounded cache of results, so that the same mesh is not measured twice.

A solver under `vmap` steps all of its lanes until the last one is done: those that have converged
ask for the same bits again and again. A look-up takes 0.1 ms where measuring takes 15 or more.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence

import numpy as np
from jaxtyping import Integer

from spt_jax._settings import config

Results = tuple[np.ndarray, ...]
# The vertices of one mesh in their own dtype, and its faces as `ResultCache.faces` returns them.
Mesh = tuple[np.ndarray, np.ndarray]
# The query's number, then the mesh: dtype, shape, identity of the faces, the bytes.
_Key = tuple[int, str, tuple[int, ...], int, bytes]

# What Python allocates for one entry beside the arrays.
_ENTRY_BYTES = 1024


class ResultCache:
    """A cache of results, keyed by the bytes of the vertices; safe with any number of threads.

    An embedded body takes 0.3 MB in float32, so the default of 64 MB holds 200 of them.

    Args:
        most_bytes: of vertices and results together; the least recently used are evicted. None: as
            `spt_jax.config` says.
        most_faces: how many lists of faces are kept; results of evicted ones are dropped.
        most_queries: for how many different queries results are kept. A query's options may be
            large: groups of faces, a rest surface with its table of 50 MB.
    """

    def __init__(self, most_bytes: int | None = None, most_faces: int = 4, most_queries: int = 8):
        self._most_bytes, self._most_faces = most_bytes, most_faces
        self._most_queries = most_queries
        self._lock = threading.Lock()
        self._results: OrderedDict[_Key, Results] = OrderedDict()
        self._bytes = 0
        self._faces: list[tuple[np.ndarray, np.ndarray]] = []
        self._queries: OrderedDict[Hashable, int] = OrderedDict()
        self._next = 0

    def faces(self, given: Integer[np.ndarray, "F 3"]) -> np.ndarray:
        """The faces as int64: for equal ones the same array, which nobody may write to."""
        with self._lock:
            for at, (known, faces) in enumerate(self._faces):
                if known.dtype == given.dtype and np.array_equal(known, given):
                    self._faces.insert(0, self._faces.pop(at))
                    return faces
            known, faces = given.copy(), given.astype(np.int64)
            faces.flags.writeable = False
            self._faces.insert(0, (known, faces))
            for _, evicted in self._faces[self._most_faces :]:
                self._drop_all(3, id(evicted))
            del self._faces[self._most_faces :]
            return faces

    def results(
        self,
        query: Hashable,
        meshes: Sequence[Mesh],
        measured: Callable[[list[Mesh]], Sequence[Results]],
    ) -> list[Results]:
        """Results for each mesh; `measured` is called at most once, for those not in the cache.

        Args:
            query: what is measured; results are shared by equal meshes of equal queries.
            meshes: some of them may be equal to each other.
            measured: a pure function that returns the results of each of several meshes.

        Returns:
            Arrays that may be in the cache: copy them, never write to them.
        """
        number = self._number_of(query)
        # The bytes themselves: -0.0 is not 0.0, NaN is itself, and no two meshes share a digest.
        keys = [
            (number, vertices.dtype.str, vertices.shape, id(faces), vertices.tobytes())
            for vertices, faces in meshes
        ]
        found = {key: self._look_up(key) for key in keys}
        fresh = {key: mesh for key, mesh in zip(keys, meshes, strict=True) if found[key] is None}
        if fresh:
            for key, results in zip(fresh, measured(list(fresh.values())), strict=True):
                self._keep(key, results)
                found[key] = results
        return [results for key in keys if (results := found[key]) is not None]

    def clear(self) -> None:
        """Drop all results."""
        with self._lock:
            self._results.clear()
            self._queries.clear()
            self._bytes = 0

    def clear_all(self) -> None:
        """Drop all results and all faces."""
        self.clear()
        with self._lock:
            self._faces.clear()

    def _number_of(self, query: Hashable) -> int:
        with self._lock:
            if query in self._queries:
                self._queries.move_to_end(query)
                return self._queries[query]
            # Never a number that was given before: results being computed may still carry it.
            self._queries[query] = self._next
            self._next += 1
            while len(self._queries) > self._most_queries:
                self._drop_all(0, self._queries.popitem(last=False)[1])
            return self._queries[query]

    def _look_up(self, key: _Key) -> Results | None:
        with self._lock:
            if key in self._results:
                self._results.move_to_end(key)
            return self._results.get(key)

    def _keep(self, key: _Key, results: Results) -> None:
        with self._lock:
            # The query or the faces may have been evicted meanwhile, and the faces' id reused.
            current = key[0] in self._queries.values()
            current &= any(id(faces) == key[3] for _, faces in self._faces)
            if key in self._results or not current:
                return
            self._results[key] = results
            self._bytes += _size(key, results)
            most = self._most_bytes
            most = config.result_cache_bytes if most is None else most
            while self._bytes > most:
                self._bytes -= _size(*self._results.popitem(last=False))

    def _drop_all(self, part: int, value: int) -> None:
        for key in [key for key in self._results if key[part] == value]:
            self._bytes -= _size(key, self._results.pop(key))


def _size(key: _Key, results: Results) -> int:
    return _ENTRY_BYTES + len(key[-1]) + sum(x.nbytes for x in results)
