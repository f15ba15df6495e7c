"""Several people in one scene: none in another, by ipctk."""

import ipctk
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spt_jax import RESULTS, PinholeCamera, fit_people, load_body, load_mocap
from spt_jax.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle

# Two people in each other's arms: chest to chest and turned to each other, hands on the other's
# back, from two frames of motion capture.
FRAMES = ("dance_a/0040", "punch/0030")
APART = 0.24  # metres from pelvis to pelvis; the bodies are about as deep


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def embrace(body):
    """Poses and places in the axes of a camera: y down."""
    mocap = load_mocap()
    poses = []
    for name, turn in zip(FRAMES, (np.pi / 2, -np.pi / 2), strict=True):
        pose = body.pose_from_smpl(jnp.asarray(mocap.pose[mocap.names.index(name)]))
        upright = matrix_from_axis_angle(jnp.array([0.0, turn, 0.0]))
        over = jnp.diag(jnp.array([1.0, -1.0, -1.0]))
        poses.append(pose.at[0].set(axis_angle_from_matrix(over @ upright)))
    places = jnp.array([[-APART / 2, 0.0, 0.0], [APART / 2, 0.0, 0.0]])
    return jnp.stack(poses), places


@pytest.fixture(scope="module")
def fitted(body, embrace):
    poses, places = embrace
    camera = PinholeCamera(1200.0, (500.0, 500.0), translation=(0.0, 0.0, 3.5))
    joints = body(poses, translation=places).joints[:, :22]
    noise = np.random.default_rng(3).normal(scale=3.0, size=(2, 22, 2))
    seen = camera.project(joints) + jnp.asarray(noise, joints.dtype)
    steps = []
    found = fit_people(body, seen, camera, layout="smpl", regularizer="none", on_step=steps.append)
    return found, seen, steps


def intersecting_pairs_between(body, vertices):
    """How often an edge of the one body passes through a triangle of the other, by ipctk."""
    count = body.num_vertices
    both = np.asfortranarray(np.asarray(vertices, np.float64).reshape(-1, 3))
    faces = np.asarray(body.faces, np.int32)
    faces = np.asfortranarray(np.concatenate([faces, faces + count]))
    edges = np.asfortranarray(ipctk.edges(faces), np.int32)
    boxes = ipctk.LBVH()
    boxes.build(both, edges, faces)
    found = 0
    for candidate in boxes.detect_edge_face_candidates():
        edge, face = edges[candidate.edge_id], faces[candidate.face_id]
        if (edge[0] < count) != (face[0] < count):
            found += ipctk.is_edge_intersecting_triangle(*both[edge], *both[face])
    return found


@pytest.mark.long
def test_people_who_embrace_end_apart(body, fitted):
    found, seen, steps = fitted
    assert [step.stage for step in steps] == list(range(len(steps)))
    assert bool(jnp.all(found.status == RESULTS.successful))
    assert len(steps) >= 6 and len(steps[0].vertices) == 2 * body.num_vertices
    assert steps[0].intersecting_pairs > 0
    assert int(found.before.intersecting_pairs_between) > 0
    assert int(found.after.intersecting_pairs_between) == 0
    assert intersecting_pairs_between(body, found.people.vertices) == 0
    assert float(found.after.volume_between) == 0.0
    assert float(found.after.volume_within) <= max(1e-8, float(found.before.volume_within))
    off = jnp.linalg.norm(found.people.keypoints - seen, axis=-1)
    assert float(off.mean()) < 12.0  # pixels, of people 580 pixels tall, with noise of 3


def test_what_is_no_scene_is_refused(body):
    camera = PinholeCamera(1200.0, (500.0, 500.0))
    points = np.zeros((22, 2), np.float32)
    with pytest.raises(ValueError, match=r"keypoints must have shape \(N, K, 2\).*batch of \(\)"):
        fit_people(body, points, camera, layout="smpl")
    with pytest.raises(TypeError, match="keypoints must be known"):
        jax.eval_shape(lambda x: fit_people(body, x, camera, layout="smpl"), points)


def test_what_is_no_option_of_a_scene_is_refused(body, untyped):
    camera = PinholeCamera(1200.0, (500.0, 500.0))
    points = np.zeros((2, 22, 2), np.float32)
    with pytest.raises(TypeError, match=r"scene must be a spt_jax\.fit\.Scene: got float"):
        fit_people(body, points, camera, layout="smpl", scene=1.0)
