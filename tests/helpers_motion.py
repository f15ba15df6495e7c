"""A body of two arms, one of them named as a foot is, with few triangles, and motions of it."""

import functools

import jax.numpy as jnp
import numpy as np
import trimesh

from spt_jax import BodyModel

RADIUS, LENGTH, APART = 0.05, 0.4, 0.3


@functools.cache
def tongs(apart=APART, dtype="float32"):
    """Two upright arms beside each other that turn where they stand, and a trunk far below."""
    arm = trimesh.creation.capsule(height=LENGTH, radius=RADIUS, count=[8, 8])
    trunk = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    trunk.apply_translation([0.0, -1.0, 0.0])
    pivots = np.array([[0.0, -1.0, 0.0], [-apart / 2, 0.0, 0.0], [apart / 2, 0.0, 0.0]])
    up = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    half = [0.0, LENGTH / 2, 0.0]  # it is made around its middle
    arms = [arm.copy().apply_transform(up).apply_translation(p + half) for p in pivots[1:]]
    parts = [trunk, *arms]
    owner = np.repeat(np.arange(3), [len(part.vertices) for part in parts])
    start = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + k for part, k in zip(parts, start, strict=True)])
    return BodyModel(
        template=jnp.asarray(vertices, dtype),
        shape_basis=jnp.zeros((len(vertices), 3, 1), dtype),
        joint_template=jnp.asarray(pivots, dtype),
        joint_shape_basis=jnp.zeros((3, 3, 1), dtype),
        weights=jnp.asarray(np.eye(3)[owner], dtype),
        faces=jnp.asarray(faces, jnp.int32),
        parents=(-1, 0, 0),
        joint_names=("trunk", "left_ankle", "right_wrist"),
    )


def snap(frames=41, lean=0.55, width=4.0, dtype="float32"):
    """The arms lean towards each other and back again, once; they collide in the middle.

    A little more on one side and a little forwards, so that nothing is symmetric.
    """
    time = np.arange(frames) - (frames - 1) / 2
    closed = lean * np.exp(-((time / width) ** 2) / 2)
    pose = np.zeros((frames, 3, 3))
    pose[:, 0] = [0.1, 0.7, -0.2]
    pose[:, 1, 2], pose[:, 2, 2] = -closed, 0.9 * closed
    pose[:, 1, 0] = 0.1 + 0.05 * np.sin(time / 7)
    return pose.astype(dtype)


def skin(body, pose):
    """The vertices of each frame, in float64."""
    return np.asarray(body(jnp.asarray(pose)).vertices, np.float64)


def second_differences(vertices):
    """Of every frame but the first and the last, the largest of a vertex."""
    return np.linalg.norm(np.diff(vertices, n=2, axis=0), axis=-1).max(axis=1)


@functools.cache
def smpl_tongs():
    """The same with the joints of SMPL, of which two move skin: an ankle and a wrist."""
    from spt_jax.body.poses import SMPL_LAYOUTS

    body, names = tongs(), SMPL_LAYOUTS[22]
    at = np.array([0, names.index("left_ankle"), names.index("right_wrist")])
    weights = np.zeros((body.num_vertices, 22), np.float32)
    weights[:, at] = body.weights
    joints = np.zeros((22, 3), np.float32)
    joints[at] = body.joint_template
    joints[names.index("head")] = [0.0, 1.0, 0.0]
    return BodyModel(
        template=body.template,
        shape_basis=body.shape_basis,
        joint_template=jnp.asarray(joints),
        joint_shape_basis=jnp.zeros((22, 3, 1)),
        weights=jnp.asarray(weights),
        faces=body.faces,
        parents=(-1, *[0] * 21),
        joint_names=names,
    )
