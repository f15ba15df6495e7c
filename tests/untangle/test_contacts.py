"""Contact that is kept while a pose is freed."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers import embedded_body, mocap

from spt_jax import contact_penalty, find_contacts, untangle_pose
from spt_jax.body import adapt

SIZE, OVERLAP, GAP, MARGIN = 0.1, 0.03, 0.004, 0.002


def _three_boxes():
    """One in another, and a third beside it, on the side to which the second one has to go."""
    box = trimesh.creation.box([SIZE] * 3).subdivide().subdivide()
    # Vertices 25 mm apart, which nearly meet those of the next box.
    places = np.array([[0.0, 0, 0], [SIZE - OVERLAP, 0.053, 0.003], [-GAP - OVERLAP, 0.131, 0.006]])
    count = len(box.vertices)
    shift = np.array([0.3, 0, 0])
    rest = np.concatenate([box.vertices + k * shift for k in range(3)]).astype("float32")
    faces = np.concatenate([box.faces + k * count for k in range(3)])
    home = shift * np.arange(3)[:, None]
    part = np.repeat(np.arange(3), count)

    def function(pose):
        return jnp.asarray(rest) + pose[part]

    body = adapt(function, faces=faces, rest_pose=jnp.zeros((3, 3), jnp.float32))
    return body, jnp.asarray(places - home, jnp.float32)


@pytest.fixture(scope="module")
def three():
    return _three_boxes()


def _distance(body, vertices, pair):
    return float(jnp.sqrt(contact_penalty(jnp.asarray(vertices), body.faces, [pair])))


def test_boxes_that_touch_stay_together(three):
    body, pose = three
    posed = body(pose).vertices
    pairs = find_contacts(body, posed, distance=0.008)
    parts = [tuple(int(body.part_groups[patch[0]]) for patch in pair) for pair in pairs]
    assert parts == [(0, 1), (1, 2)]
    touching = pairs[1]
    assert _distance(body, posed, touching) == pytest.approx(GAP, abs=1e-5)
    alone = untangle_pose(body, pose)
    assert alone.is_free and _distance(body, alone.vertices, touching) > GAP + 0.005
    for contacts, weight, off in (("found", 20.0, 0.003), (pairs, 400.0, 0.0005)):
        kept = untangle_pose(
            body, pose, contacts=contacts, contact_distance=0.008, contact_weight=weight
        )
        assert kept.is_free
        assert _distance(body, kept.vertices, touching) < GAP + off
        # What was in each other touches: at the margin, at which the overlap moved outwards ends.
        assert MARGIN / 2 < _distance(body, kept.vertices, pairs[0]) < MARGIN + 0.001
    let_go = untangle_pose(body, pose, contacts="found", contact_weight=0.0)
    np.testing.assert_array_equal(let_go.pose, alone.pose)


def test_parts_of_a_body_in_contact():
    body, names = embedded_body(), list(mocap().names)
    crouching = body.pose_from_smpl(jnp.asarray(mocap().pose[names.index("roll/0095")]))
    posed = np.asarray(body(crouching).vertices)
    pairs = find_contacts(body, posed)
    named = [{body.joint_names[body.part_groups[patch[0]]] for patch in pair} for pair in pairs]
    assert named and all(len(two) == 2 for two in named)
    for pair in pairs:
        corners = [posed[np.unique(body.faces[patch])] for patch in pair]
        apart = np.linalg.norm(corners[0][:, None] - corners[1], axis=-1)
        assert apart.min() <= 0.02
    assert find_contacts(body, body.template) == []  # arms are away from the trunk


def test_contacts_that_are_none(three, untyped):
    body, pose = three
    with pytest.raises(ValueError, match="contacts must be 'found'"):
        untangle_pose(body, pose, contacts="near")
    with pytest.raises(ValueError, match="must name triangles of the mesh"):
        untangle_pose(body, pose, contacts=[([0], [len(body.faces)])])
    with pytest.raises(ValueError, match="contact_distance must be finite"):
        untangle_pose(body, pose, contacts="found", contact_distance=-1.0)
    with pytest.raises(ValueError, match="one posed body"):
        find_contacts(body, body(pose[None]).vertices)
    with pytest.raises(ValueError, match="2 values that are not"):
        find_contacts(body, body(pose).vertices.at[0, :2].set(jnp.nan))
