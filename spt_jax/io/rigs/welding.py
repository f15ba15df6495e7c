"""The primitives of a character as one surface: seams of its texture closed again."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from spt_jax.io.meshes.seams import closed_seams

# Along a seam that one program wrote weights agree to a byte; where two parts meet they may differ
# somewhat. What differs by more, as the lids of an eye that is shut, are two surfaces.
_ALIKE, _SAME = 0.1, 1e-3
# Of morph targets, as a part of the character's extent.
_TARGETS = 1e-4


class Mesh(NamedTuple):
    """A character's surface in the space of the bind pose.

    Attributes:
        vertices, faces: the surface.
        weights: of each vertex to each bone.
        targets: what each morph target adds.
        bones, inverse_bind: of each bone its joint, and what takes vertices into its space.
        rows: of each vertex of the file, that of this mesh; -1 where no triangle has it.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    weights: Float[np.ndarray, "V K"]
    targets: Float[np.ndarray, "V 3 M"]
    bones: tuple[int, ...]
    inverse_bind: Float[np.ndarray, "K 4 4"]
    rows: Int[np.ndarray, "R"]

    @classmethod
    def empty(cls, vertices: int, bones: int, targets: int) -> "Mesh":
        """Zeros, to be filled."""
        return cls(
            np.zeros((vertices, 3)),
            np.zeros((0, 3), np.int64),
            np.zeros((vertices, bones)),
            np.zeros((vertices, 3, targets)),
            (),
            np.zeros((bones, 4, 4)),
            np.arange(vertices),
        )


def welded(mesh: Mesh, notes: list[str]) -> Mesh:
    """The mesh with vertices joined that were one before the file was written.

    Those on open edges, at one place, that are skinned and morphed alike.
    """
    _, _, group, _ = closed_seams(mesh.vertices, mesh.faces, False)
    first = _leaders(mesh, group)
    kept, rows = np.unique(first, return_inverse=True)
    faces = rows[mesh.faces]
    gone = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    weights = mesh.weights[kept]
    joined = np.flatnonzero(kept[rows] != np.arange(len(rows)))
    apart = np.abs(mesh.weights[joined] - weights[rows[joined]]).max(axis=1, initial=0.0)
    if (apart > _SAME).any():
        notes.append(
            f"where parts meet {int((apart > _SAME).sum())} vertices have weights that differ by "
            f"up to {apart.max():.3f}; their mean is used"
        )
        count = np.bincount(rows, minlength=len(kept))
        weights = np.zeros_like(weights)
        np.add.at(weights, rows, mesh.weights)
        weights /= count[:, None]
    if gone.any():
        notes.append(f"{int(gone.sum())} triangles without area left out")
    faces = faces[~gone]
    # Primitives that share an array of vertices use a part of it each.
    used = np.zeros(len(kept), bool)
    used[faces] = True
    place = np.where(used, np.cumsum(used) - 1, -1)
    return mesh._replace(
        vertices=mesh.vertices[kept[used]],
        faces=place[faces],
        weights=weights[used],
        targets=mesh.targets[kept[used]],
        rows=place[rows],
    )


def _leaders(mesh: Mesh, group: Int[np.ndarray, "V"]) -> Int[np.ndarray, "V"]:
    """Of each vertex the first one of its group that is skinned and morphed as it is."""
    allowed = _TARGETS * max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-12)
    leader = np.arange(len(group))
    # Nearly all are alone.
    left = np.flatnonzero(np.bincount(group)[group] > 1)
    while len(left):
        _, first, of = np.unique(group[left], return_index=True, return_inverse=True)
        head = left[first][of]
        alike = np.abs(mesh.weights[left] - mesh.weights[head]).max(axis=1, initial=0.0) <= _ALIKE
        moved = np.abs(mesh.targets[left] - mesh.targets[head]).max(axis=(1, 2), initial=0.0)
        alike &= moved <= allowed
        leader[left[alike]] = head[alike]
        left = left[~alike]
    return leader
