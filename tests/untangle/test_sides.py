"""Limbs that passed through other parts: which limbs they are, and where else they could be."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import embedded_body
from helpers_collisions import body_exclusions, posed_by, with_joints

from spt_jax import untangle_pose
from spt_jax.body import swings
from spt_jax.overlap.measure import Sampling, measure
from spt_jax.untangle import sides


def look(pose):
    vertices = posed_by(pose)
    faces = np.asarray(embedded_body().faces, np.int64)
    found = measure(vertices, faces, Sampling(None, ((0.0, 0.0, -1.0),)), body_exclusions(), 1e-7)
    return found


THROUGH = with_joints({"left_shoulder": (0.0, 0.0, -1.9)})  # down through the hip


def test_the_limb_that_collides_is_found():
    body = embedded_body()
    limbs = swings.limbs_in_collision(look(THROUGH), body.part_groups, body.parents)
    assert body.joint_names[limbs[0]] in ("left_collar", "left_shoulder")


def test_places_on_other_sides_are_free_and_the_nearest_come_first():
    body = embedded_body()

    def free(pose):
        found = look(pose)
        return not found.intersecting_pairs, found.vertices

    pose = np.asarray(THROUGH, np.float64)
    starts = swings.free_starts(pose, [body.joint_names.index("left_shoulder")], free, 3)
    assert starts and [s.moved for s in starts] == sorted(s.moved for s in starts)
    for start in starts:
        assert free(start.pose)[0]
        changed = np.flatnonzero((start.pose != pose).any(axis=1))
        assert changed.tolist() == [body.joint_names.index("left_shoulder")]


@pytest.mark.long
def test_what_is_nearer_on_another_side_is_taken(monkeypatch):
    body, pose = embedded_body(), jnp.asarray(THROUGH)
    monkeypatch.setattr(sides, "_FAR", np.inf)
    here = untangle_pose(body, pose)
    monkeypatch.setattr(sides, "_FAR", 0.0)
    best = untangle_pose(body, pose)
    assert best.is_free and here.is_free
    moved = [
        float(np.sqrt(((np.asarray(r.vertices) - posed_by(pose)) ** 2).sum(axis=1).mean()))
        for r in (here, best)
    ]
    assert moved[1] <= moved[0] * 1.001
