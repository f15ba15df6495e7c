"""What the live view shows: a body in a pose or a mesh, and what is measured of it; no viser."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Int8
from scipy.spatial.transform import Rotation

from spt_jax._query import as_directions
from spt_jax.body import AbstractBody
from spt_jax.io.mesh_files import fits_single
from spt_jax.overlap.exclusions import NOTHING, Exclusions
from spt_jax.overlap.labels import LabelCounts, count_labels
from spt_jax.overlap.measure import Rule, Sampling, Unmeasurable, measure

_EXACT = Sampling(None, as_directions(3))
# The paper's own settings, `paper_penalty`: 512 rays along -z.
_PAPER = Sampling(512, as_directions(1))

_FINGERS = ("thumb", "index", "middle", "ring", "pinky", "hand")
_LEG = ("hip", "knee", "ankle", "foot")
_ARM = ("collar", "shoulder", "elbow", "wrist")
_HEAD = ("neck", "head", "jaw", "eye")


@dataclass(frozen=True, eq=False)
class Reading:
    """One look at the surface.

    Attributes:
        vertices: the positions that were measured.
        labels: +1 penetrating, -1 inverted, 0 clear.
        volume: the included overlap volume, in the cube of the vertices' unit.
        intersecting_pairs: the number of face pairs that intersect and count.
        milliseconds: that measuring took.
        error: why there is nothing to measure, in one line; then the volume is NaN and no vertex is
            in self-intersection. None: it was measured.
    """

    vertices: Float[np.ndarray, "V 3"]
    labels: Int8[np.ndarray, "V"]
    volume: float
    intersecting_pairs: int
    milliseconds: float
    error: str | None = None

    @property
    def is_free(self) -> bool:
        """Whether it was measured, no faces intersect and no parts overlap."""
        return self.error is None and not self.intersecting_pairs and not self.volume > 0

    @property
    def counts(self) -> LabelCounts:
        """The numbers of clear, penetrating and inverted vertices."""
        return count_labels(self.labels)


class Scene:
    """A body with its pose, or a mesh; it belongs to one thread.

    Attributes:
        name: what is shown.
        faces: triangles, int64.
        body: None for a mesh.
        pose: axis-angle of each joint, radians; no rows for a mesh.
        shape: coefficients; none for a mesh.
        translation: in metres.
        count_folds: whether folds of skin at joints are included.
        paper: measure as the paper does: the triangle rule on 512 rays along one direction.
    """

    def __init__(
        self,
        name: str,
        faces: Int[Any, "F 3"],
        *,
        body: AbstractBody | None = None,
        vertices: Float[np.ndarray, "V 3"] | None = None,
    ):
        if (body is None) == (vertices is None):
            raise ValueError("a scene shows either a body or the vertices of a mesh: give one.")
        self.name = name
        self.faces = np.asarray(faces, np.int64)
        self.body = body
        joints, shapes = (body.num_joints, body.num_shape) if body else (0, 0)
        self.pose = np.zeros((joints, 3), np.float32)
        self.shape = np.zeros(shapes, np.float32)
        self.translation = np.zeros(3, np.float32)
        self.count_folds = self.paper = False
        # Vertices that no pose explains: a mesh's own, or a body's skin freed of its folds.
        self._free = vertices
        self._posed: tuple[np.ndarray, np.ndarray] | None = None
        self._loaded = self._state()

    @classmethod
    def of_body(cls, body: AbstractBody, name: str) -> "Scene":
        """A body at rest."""
        return cls(name, body.faces, body=body)

    @classmethod
    def of_mesh(
        cls, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], name: str
    ) -> "Scene":
        """A mesh, in float32 as the files that are written hold it.

        In float64 where it lies so far from the origin that rounding would show.
        """
        single = vertices.astype(np.float32) if fits_single(vertices) else vertices
        return cls(name, faces, vertices=single)

    def load(
        self,
        pose: Float[np.ndarray, "J 3"],
        shape: Float[np.ndarray, "B"] | None = None,
        translation: Float[np.ndarray, "3"] | None = None,
    ) -> None:
        """Take a pose of the body's own joints, which `reset` comes back to."""
        self.set_pose(pose)
        self.shape[:] = 0.0
        if shape is not None:
            self.shape[: len(shape)] = shape[: len(self.shape)]
        self.translation[:] = 0.0 if translation is None else translation
        self._loaded = self._state()

    def reset(self) -> None:
        """Back to what was loaded."""
        pose, shape, translation, free = self._loaded
        self.pose, self.shape, self.translation = pose.copy(), shape.copy(), translation.copy()
        self._free, self._posed = free, None

    def set_pose(self, pose: Float[np.ndarray, "J 3"]) -> None:
        """Take another pose; shape and translation stay."""
        self._change()
        self.pose = np.array(pose, np.float32)

    def set_shape(self, component: int, value: float) -> None:
        """Set one shape coefficient."""
        self._change()
        self.shape[component] = value

    def turn(self, joint: int, axis: int, degrees: float) -> None:
        """Set one component of a joint's axis-angle, in degrees."""
        self._change()
        self.pose[joint, axis] = np.radians(degrees)

    def turn_in_world(self, joint: int, wxyz: Sequence[float]) -> None:
        """Turn one joint so that its frame has the orientation given in the world."""
        parent = self._parents[joint]
        local = Rotation.from_quat(np.roll(np.asarray(wxyz, np.float64), -1))
        if parent >= 0:
            local = self._world_rotations()[parent].inv() * local
        self._change()
        self.pose[joint] = local.as_rotvec()

    def set_free_vertices(self, vertices: Float[np.ndarray, "V 3"]) -> None:
        """Show these vertices; a body goes back to its posed ones as soon as its pose changes."""
        self._free = np.array(vertices)

    @property
    def vertices(self) -> Float[np.ndarray, "V 3"]:
        """The surface as it stands; poses the body where something changed."""
        return self._pose_body()[0] if self._free is None else self._free

    @property
    def joints(self) -> Float[np.ndarray, "J 3"]:
        """The joints' positions."""
        return self._pose_body()[1] if self.body else np.zeros((0, 3), np.float32)

    def orientations(self) -> Float[np.ndarray, "J 4"]:
        """Each joint's orientation in the world, as a quaternion w, x, y, z."""
        quaternions = [rotation.as_quat() for rotation in self._world_rotations()]
        return np.roll(np.array(quaternions).reshape(-1, 4), 1, axis=1)

    def read(self, vertices: Float[np.ndarray, "V 3"] | None = None) -> Reading:
        """Measure the surface, or other vertices of it: NumPy alone, so from any thread.

        A surface that cannot be measured, such as one that is not finite, gives a reading that says
        so in its `error`.
        """
        vertices = self.vertices if vertices is None else vertices
        start = time.perf_counter()
        exclusions = NOTHING if self.count_folds else self._without_folds
        sampling, rule = (_PAPER, "triangle") if self.paper else (_EXACT, "vertex")
        points = np.asarray(vertices, np.float64)
        return _read(points, vertices, self.faces, sampling, exclusions, rule, start)

    @cached_property
    def _without_folds(self) -> Exclusions:
        return NOTHING if self.body is None else Exclusions(rest=self.body.rest_surface)

    @cached_property
    def _parents(self) -> tuple[int, ...]:
        return self.body.parents if self.body else ()

    def _world_rotations(self) -> list[Rotation]:
        world: list[Rotation] = []
        for parent, row in zip(self._parents, self.pose.astype(np.float64), strict=True):
            local = Rotation.from_rotvec(row)
            world.append(world[parent] * local if parent >= 0 else local)
        return world

    def _pose_body(self) -> tuple[np.ndarray, np.ndarray]:
        if self._posed is None:
            if self.body is None:
                raise ValueError("a mesh has no pose.")
            posed = self.body(self.pose, self.shape, self.translation)
            self._posed = np.asarray(posed.vertices), np.asarray(posed.joints)
        return self._posed

    def _change(self) -> None:
        if self.body is not None:
            self._free = self._posed = None

    def _state(self):
        return self.pose.copy(), self.shape.copy(), self.translation.copy(), self._free


def _read(
    points: Float[np.ndarray, "V 3"],
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    sampling: Sampling,
    exclusions: Exclusions,
    rule: Rule,
    start: float,
) -> Reading:
    rounding = float(np.finfo(vertices.dtype).eps)
    error = None
    try:
        found = measure(points, faces, sampling, exclusions, rounding)
        volume, labels, pairs = float(found.volume), found.labels(rule), found.intersecting_pairs
    except Unmeasurable as reason:
        volume, labels, pairs = float("nan"), np.zeros(len(vertices), np.int8), 0
        error = " ".join(str(reason).split())
    milliseconds = 1e3 * (time.perf_counter() - start)
    return Reading(vertices, labels.astype(np.int8), volume, pairs, milliseconds, error)


def body_parts(joint_names: tuple[str, ...]) -> dict[str, tuple[int, ...]]:
    """Joints by the part of the body that they move, so that a list of 52 can be used.

    Example:
        >>> from spt_jax.view.scene import body_parts
        >>> body_parts(("pelvis", "left_hip", "left_knee", "right_index1", "jaw"))
        {'trunk': (0,), 'head': (4,), 'left leg': (1, 2), 'right hand': (3,)}
    """
    order = ["trunk", "head"]
    order += [f"{side} {part}" for part in ("arm", "leg", "hand") for side in ("left", "right")]
    found: dict[str, list[int]] = {part: [] for part in order}
    for joint, name in enumerate(joint_names):
        side = next((side for side in ("left", "right") if name.startswith(side)), None)
        kinds = (("hand", _FINGERS), ("leg", _LEG), ("arm", _ARM))
        kind = next((kind for kind, words in kinds if any(word in name for word in words)), None)
        if any(word in name for word in _HEAD):
            found["head"].append(joint)
        elif side and kind:
            found[f"{side} {kind}"].append(joint)
        else:
            found["trunk"].append(joint)
    return {part: tuple(joints) for part, joints in found.items() if joints}
