"""A slow, obvious body model in NumPy, and a writer of small synthetic SMPL files."""

import pickle
import struct
import sys
import types
from typing import Any, ClassVar

import numpy as np
import scipy.sparse
import trimesh

from spt_jax.body import load_body
from spt_jax.body.poses import SMPL_LAYOUTS

# Columns of kintree_table, root first, for SMPL, SMPL-H and SMPL-X.
_BODY_PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19]


_LEGS = [6, 7, 8, 9, 6, 11, 12, 13]
_BACK_LEGS = [0, 17, 18, 19, 0, 21, 22, 23]


def _finger_parents(left, right, first):
    parents = []
    for wrist in (left, right):
        for _ in range(5):
            parents += [wrist, first + len(parents), first + len(parents) + 1]
    return parents


# MANO, FLAME, SMAL with and without ears, SUPR (of whose tree the tests need nothing but a tree).
PARENTS = {
    16: [-1, *(parent for first in range(1, 16, 3) for parent in (0, first, first + 1))],
    5: [-1, 0, 1, 1, 1],
    33: [-1, *range(6), *_LEGS, 6, 15, *_BACK_LEGS, 0, *range(25, 31), 16],
    35: [-1, *range(6), *_LEGS, 6, 15, *_BACK_LEGS, 0, *range(25, 31), 16, 16, 16],
    75: [-1, *(k // 2 for k in range(74))],
    24: [*_BODY_PARENTS, 20, 21],
    52: [*_BODY_PARENTS, *_finger_parents(20, 21, 22)],
    55: [*_BODY_PARENTS, 15, 15, 15, *_finger_parents(20, 21, 25)],
}


def slow_rotation(axis_angle):
    """Rodrigues' formula for one vector."""
    angle = np.linalg.norm(axis_angle)
    if angle == 0:
        return np.eye(3)
    x, y, z = axis_angle / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def slow_body(smpl, pose, shape, translation, keep=slice(None)):
    """SMPL's published formulas with loops over joints and vertices, in float64.

    `smpl` holds v_template, shapedirs, posedirs (or None), weights, J_regressor (or J and
    J_shapedirs) and parents.
    """
    shapedirs = np.asarray(smpl["shapedirs"], np.float64)[..., : len(shape)]
    v_shaped = smpl["v_template"] + shapedirs @ shape
    if "J_regressor" in smpl:
        joints = slow_joints(smpl["J_regressor"], v_shaped)
    else:
        joints = smpl["J"] + np.asarray(smpl["J_shapedirs"], np.float64) @ shape
    rotations = [slow_rotation(row) for row in np.asarray(pose, np.float64)]
    v_posed = v_shaped
    if smpl.get("posedirs") is not None:
        feature = slow_features(smpl["posedirs"].shape[-1], pose, rotations, shape)
        v_posed = v_shaped + smpl["posedirs"] @ feature

    world = []
    for joint, parent in enumerate(smpl["parents"]):
        local = np.eye(4)
        local[:3, :3] = rotations[joint]
        local[:3, 3] = joints[joint] - (joints[parent] if joint else 0)
        world.append(world[parent] @ local if joint else local)
    posed = []
    for vertex, weights in zip(v_posed[keep], smpl["weights"][keep], strict=True):
        total = np.zeros(3)
        for joint, weight in enumerate(weights):
            total += weight * (
                world[joint][:3, :3] @ (vertex - joints[joint]) + world[joint][:3, 3]
            )
        posed.append(total + translation)
    return np.array(posed), np.array([w[:3, 3] for w in world]) + translation


def slow_joints(regressor, points):
    """SMPL's regressor, or SUPR's, which takes all coordinates in one row and a constant."""
    if regressor.shape[1] == len(points):
        return regressor @ points
    return (regressor @ np.append(points.ravel(), 1.0)).reshape(-1, 3)


def slow_features(columns, pose, rotations, shape):
    """What pose blend shapes go by: SMPL's equation 8, STAR's equation 5 or SUPR's equation 6."""
    if columns == 9 * (len(pose) - 1):
        return np.concatenate([(r - np.eye(3)).ravel() for r in rotations[1:]])
    quaternions = []
    for row in np.asarray(pose, np.float64):
        angle = np.linalg.norm(row)
        axis = row / angle if angle else row
        quaternions.append([*np.sin(angle / 2) * axis, np.cos(angle / 2) - 1])
    if columns == 4 * len(pose):
        return np.ravel(quaternions)
    return np.append(np.ravel(quaternions[1:]), shape[1] if len(shape) > 1 else 0.0)


def synthetic_smpl(rng, joints=24, vertices=60, components=10, features=None):
    """Arrays with the keys, shapes and dtypes of a file of the SMPL family, and random numbers."""
    parents = PARENTS[joints]
    weights = rng.random((vertices, joints)) * (rng.random((vertices, joints)) < 0.2)
    weights[:, 0] += 0.1
    regressor = rng.random((joints, vertices)) * (rng.random((joints, vertices)) < 0.2)
    regressor[:, 0] += 0.1
    table = np.array([parents, range(joints)], np.int64).astype(np.uint32)  # -1: 4294967295
    return {
        "v_template": rng.normal(size=(vertices, 3)),
        "shapedirs": 0.1 * rng.normal(size=(vertices, 3, components)),
        "posedirs": 0.05 * rng.normal(size=(vertices, 3, features or 9 * (joints - 1))),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": table,
        "f": bipyramid(vertices),
    }


def bipyramid(vertices):
    """The faces of a closed surface of so many vertices: a ring and two tips."""
    ring = np.arange(vertices - 2)
    after, above = np.roll(ring, -1), np.full(len(ring), vertices - 2)
    faces = np.concatenate([[ring, after, above], [after, ring, above + 1]], axis=1)
    return faces.T.astype(np.uint32)


def synthetic_hand(rng, names=("",)):
    """Hand components and mean poses, as MANO's files have them, or SMPL-H's and SMPL-X's."""
    return {
        f"hands_{kind}{name}": 0.3 * rng.normal(size=shape)
        for name in names
        for kind, shape in (("components", (45, 45)), ("mean", (45,)))
    }


def with_parents(smpl):
    """The arrays of a synthetic file as `slow_body` wants them."""
    return smpl | {"parents": PARENTS[smpl["kintree_table"].shape[1]]}


def _chumpy_class(module, name):
    return type(name, (), {"__module__": module})


Ch = _chumpy_class("chumpy.ch", "Ch")
Select = _chumpy_class("chumpy.reordering", "Select")


def chumpy_array(array):
    """What chumpy pickles for a leaf array."""
    value = Ch()
    value.__dict__.update(x=array, _dirty_vars=set(), _itr=None)
    return value


def chumpy_select(array, indices, shape):
    """What chumpy pickles for a slice of another array."""
    value = Select()
    value.__dict__.update(a=chumpy_array(array), idxs=indices, preferred_shape=shape)
    return value


class Python2Pickler(pickle._Pickler):
    """Writes strings and bytes as Python 2 did: one kind of string, without an encoding."""

    dispatch: ClassVar = dict(pickle._Pickler.dispatch)

    def save_string(self, value):
        raw = value.encode("latin1") if isinstance(value, str) else value
        pickler: Any = self  # of the Pickler in Python, which typeshed takes for that in C
        pickler.write(pickle.BINSTRING + struct.pack("<i", len(raw)) + raw)
        pickler.memoize(value)

    dispatch[bytes] = save_string
    dispatch[str] = save_string


def write_official_pkl(path, smpl, monkeypatch):
    """The arrays as SMPL's official files hold them: Python 2, chumpy and a sparse regressor."""
    for name in ("chumpy", "chumpy.ch", "chumpy.reordering"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setattr(sys.modules["chumpy.ch"], "Ch", Ch, raising=False)
    monkeypatch.setattr(sys.modules["chumpy.reordering"], "Select", Select, raising=False)
    shapedirs = smpl["shapedirs"]
    values = smpl | {
        "v_template": chumpy_array(smpl["v_template"]),
        "shapedirs": chumpy_select(shapedirs, np.arange(shapedirs.size), shapedirs.shape),
        "weights": chumpy_array(smpl["weights"]),
        "J_regressor": scipy.sparse.csc_matrix(smpl["J_regressor"]),
        "bs_type": "lrotmin",
        "bs_style": "lbs",
    }
    with open(path, "wb") as file:
        Python2Pickler(file, protocol=2).dump(values)
    content = path.read_bytes()
    for new, old in (
        (b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n"),
        (b"cscipy.sparse._csc\n", b"cscipy.sparse.csc\n"),
    ):
        assert new in content
        content = content.replace(new, old)
    path.write_bytes(content)
    for name in ("chumpy", "chumpy.ch", "chumpy.reordering"):
        monkeypatch.delitem(sys.modules, name)


def smpl_pose(rng, joints, *batch):
    """Random axis-angle rows of up to about half a turn, and the joints' names."""
    return rng.normal(scale=0.7, size=(*batch, joints, 3)), SMPL_LAYOUTS[joints]


def ball_arrays(subdivisions=1):
    """An SMPL file's arrays: a ball for each joint of a stick figure, all of them apart."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.05)
    names, parents = SMPL_LAYOUTS[24], PARENTS[24]
    joints = np.zeros((24, 3))
    for joint, parent in enumerate(parents[1:], start=1):
        name = names[joint]
        side = 1.0 if name.startswith("left") else -1.0 if name.startswith("right") else 0.0
        across = any(part in name for part in ("collar", "shoulder", "elbow", "wrist", "hand"))
        hip = name.endswith("hip")
        up = -0.2 if any(part in name for part in ("knee", "ankle", "foot")) else 0.2
        step = (0.2 * side, 0.0, 0.0) if across or hip else (0.0, up, 0.0)
        joints[joint] = joints[parent] + step
    count = len(ball.vertices)
    owner = np.repeat(np.arange(24), count)
    vertices = (joints[:, None] + ball.vertices).reshape(-1, 3)
    faces = (np.arange(24)[:, None, None] * count + ball.faces).reshape(-1, 3)
    return {
        "v_template": vertices,
        "shapedirs": np.ones((len(vertices), 3, 2)) * [0.01, 0.02],
        "J_regressor": (owner == np.arange(24)[:, None]) / count,
        "weights": np.eye(24)[owner],
        "kintree_table": np.array([parents, range(24)]).astype(np.uint32),
        "f": faces.astype(np.uint32),
    }


def smplx_like():
    """The arrays of an SMPL-X file: a body with a hole in its mouth, and eyeballs in its head.

    Of the embedded body: SMPL-X has eyeballs of 546 vertices each and a hole of 32 edges. The
    regressor is the smallest one that gives the body's joints.
    """
    body = load_body(num_shape=2)
    vertices, faces = np.asarray(body.template, np.float64), np.asarray(body.faces)
    joints, names = np.asarray(body.joint_template, np.float64), SMPL_LAYOUTS[55]
    head = joints[body.joint_names.index("head")]
    front = vertices[np.asarray(body.weights).argmax(1) == body.joint_names.index("head"), 2].max()
    mouth = np.array([0.0, head[1] + 0.015, front - 0.01])
    away = np.linalg.norm((vertices[faces].mean(axis=1) - mouth) * [1.0, 2.0, 1.0], axis=1)
    faces = faces[away > 0.02]
    parts, weights = [vertices], np.zeros((len(vertices), 55))
    weights[:, [names.index(name) for name in body.joint_names]] = np.asarray(body.weights)
    weights = [weights]
    where = {name: joints[k] for k, name in enumerate(body.joint_names)} | {"jaw": head}
    for side, name in ((1, "left_eye"), (-1, "right_eye")):
        eye = trimesh.creation.uv_sphere(radius=0.012, count=[18, 18])
        center = np.array([0.03 * side, head[1] + 0.06, front - 0.035])
        faces = np.concatenate([faces, eye.faces + sum(map(len, parts))])
        parts.append(eye.vertices + center)
        weights.append(np.tile(np.arange(55) == names.index(name), (len(eye.vertices), 1)))
        where[name] = center
    vertices = np.concatenate(parts)
    equations = np.column_stack([vertices, np.ones(len(vertices))]).T
    wanted = np.column_stack([np.array([where[name] for name in names]), np.ones(55)])
    return {
        "v_template": vertices,
        "shapedirs": np.zeros((len(vertices), 3, 2)),
        "J_regressor": wanted @ np.linalg.pinv(equations).T,
        "weights": np.concatenate(weights),
        "kintree_table": np.array([PARENTS[55], range(55)], np.int64).astype(np.uint32),
        "f": faces.astype(np.uint32),
    }


def cut_out(smpl, names, kept):
    """The arrays of a file of that part of a body which some joints move, with a hole at its root.

    Args:
        smpl: the whole body's arrays.
        names: of its joints.
        kept: those of the part, the root first.
    """
    rows = [names.index(name) for name in kept]
    owner = smpl["weights"][smpl["f"].astype(np.int64)].sum(axis=1).argmax(axis=1)
    used, faces = np.unique(smpl["f"][np.isin(owner, rows)], return_inverse=True)
    weights = smpl["weights"][np.ix_(used, rows)]
    weights[:, 0] += 1 - weights.sum(axis=1)  # what is beyond the root moves with it
    vertices, parents = smpl["v_template"][used], smpl["kintree_table"][0]
    joints = (smpl["J_regressor"] @ smpl["v_template"])[rows]
    tree = [-1, *(rows.index(int(parents[row])) for row in rows[1:])]
    equations = np.column_stack([vertices, np.ones(len(vertices))]).T
    return {
        "v_template": vertices,
        "shapedirs": np.zeros((len(vertices), 3, 2)),
        "J_regressor": np.column_stack([joints, np.ones(len(rows))]) @ np.linalg.pinv(equations).T,
        "weights": weights,
        "kintree_table": np.array([tree, range(len(rows))], np.int64).astype(np.uint32),
        "f": faces.reshape(-1, 3).astype(np.uint32),
    }
