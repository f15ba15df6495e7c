"""People seen by a camera, and objectives made piece by piece."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from helpers import embedded_body, mocap

from spt_jax import PinholeCamera, keypoint_regressor
from spt_jax.body import BodyModel
from spt_jax.fit.problem.figure import make_figure
from spt_jax.fit.problem.learned_priors import pose_prior
from spt_jax.fit.problem.limits import joint_limits
from spt_jax.fit.problem.objective import Objective, Weights, as_seen
from spt_jax.fit.problem.variables import Variables
from spt_jax.fit.problem.viewer import Viewer

# World with y up, and a camera that looks along -z from 4 m away, a metre above the floor.
UPRIGHT = np.diag([1.0, -1.0, -1.0])

embedded_body()  # in float32, whichever test comes first


def camera(dtype=np.float32, distance=4.0, focal=1000.0):
    return PinholeCamera(
        np.asarray(focal, dtype),
        np.asarray([500.0, 480.0], dtype),
        UPRIGHT.astype(dtype),
        np.asarray([0.1, 0.9, distance], dtype),
    )


def frames(*names):
    """Poses of the embedded body in frames of motion capture, (N, 52, 3)."""
    rows = [mocap().names.index(name) for name in names]
    return embedded_body().pose_from_smpl(jnp.asarray(mocap().pose[rows]))


def body_of(smpl, names):
    """A body from the arrays of a synthetic file."""
    regressor = smpl["J_regressor"]
    table = smpl["kintree_table"][0].astype(np.int64)
    return BodyModel(
        template=jnp.asarray(smpl["v_template"]),
        shape_basis=jnp.asarray(smpl["shapedirs"]),
        joint_template=jnp.asarray(regressor @ smpl["v_template"]),
        joint_shape_basis=jnp.asarray(np.einsum("jv,vcb->jcb", regressor, smpl["shapedirs"])),
        weights=jnp.asarray(smpl["weights"]),
        faces=jnp.asarray(smpl["f"].astype(np.int32)),
        parents=(-1, *(int(parent) for parent in table[1:])),
        joint_names=tuple(names),
        pose_basis=jnp.asarray(smpl["posedirs"]),
    )


@functools.cache
def figure(layout="smpl22"):
    with jax.ensure_compile_time_eval():  # also where a test traces
        return make_figure(embedded_body(), keypoint_regressor(embedded_body(), layout))


def objective(
    keypoints,
    *,
    layout="smpl22",
    confidence=None,
    pixels=5.0,
    robust=None,
    camera=None,
    weights=(1.0, 1.0, 1.0, 0.25),
    start=None,
    fit_shape=False,
    fit_translation=True,
):
    """The objective of one person, terms and all, without `fit_pose`."""
    body, part = embedded_body(), figure(layout)
    keypoints = jnp.asarray(keypoints)
    dtype = keypoints.dtype
    prior = pose_prior(body.joint_names)
    if start is None:
        start = Variables(prior.mean, jnp.zeros(body.num_shape), jnp.zeros(3))
    eye = globals()["camera"](dtype) if camera is None else camera
    viewer = Viewer.of(eye)
    start = Variables(*(jnp.asarray(given).astype(dtype) for given in start))
    trust = jnp.ones(len(keypoints)) if confidence is None else jnp.asarray(confidence)
    return Objective(
        figure=part,
        viewer=viewer,
        keypoints=keypoints,
        confidence=trust.astype(dtype),
        pixels=jnp.asarray(pixels, dtype),
        robust=None if robust is None else jnp.asarray(robust, dtype),
        prior=prior.of_joints(part.moving),
        limits=joint_limits(body.joint_names).of_joints(part.moving),
        weights=Weights(*(jnp.asarray(weight, dtype) for weight in weights)),
        start=start,
        seen=as_seen(part, viewer, start),
        fit_shape=fit_shape,
        fit_translation=fit_translation,
    )


def seen(pose, layout="smpl22", translation=None, shape=None, by=None):
    """Keypoints of the embedded body in a pose, as the whole body has them."""
    body = embedded_body()
    posed = body(pose, shape, translation)
    by = camera(pose.dtype) if by is None else by
    return by.project(keypoint_regressor(body, layout).of(posed))
