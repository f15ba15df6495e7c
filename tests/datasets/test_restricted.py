"""A body without some joints has the skin of the whole one with these at rest."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers_body import synthetic_smpl

from spt_jax import load_body
from spt_jax.datasets.restricted import restricted


@pytest.mark.parametrize("joints", [24, 55])
def test_the_same_skin_where_the_others_are_at_rest(tmp_path, rng, joints):
    np.savez(tmp_path / "body.npz", **synthetic_smpl(rng, joints=joints))
    body = load_body(tmp_path / "body.npz")
    names = [n for n in body.joint_names if "foot" not in n and "hand" not in n and n[-1] != "2"]
    fewer = restricted(body, names)
    assert 5 < fewer.num_joints < body.num_joints and body.pose_basis is not None
    pose = rng.normal(scale=0.3, size=(body.num_joints, 3)).astype(np.float32)
    rows = [body.joint_names.index(name) for name in fewer.joint_names]
    whole = np.zeros_like(pose)
    whole[rows] = pose[rows]
    shape = jnp.asarray(rng.normal(size=body.num_shape).astype(np.float32))
    one, other = body(whole, shape), fewer(pose[rows], shape)
    np.testing.assert_allclose(other.vertices, one.vertices, atol=2e-6)
    np.testing.assert_allclose(other.joints, np.asarray(one.joints)[rows], atol=2e-6)
    assert fewer.rest_surface == body.rest_surface
    assert restricted(body, body.joint_names) is body
