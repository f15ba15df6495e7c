"""A body with only those joints that a file can say: what is found for them can be written."""

from collections.abc import Collection

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from spt_jax.body import BodyModel
from spt_jax.body.posing import feature_columns
from spt_jax.rest.surface import RestSurface


class RestrictedBody(BodyModel):
    """A body with joints that always stay at rest; folds are recognized as on the whole body."""

    whole_rest_surface: RestSurface | None = eqx.field(static=True, default=None)

    @property
    def rest_surface(self) -> RestSurface:
        """The whole body's: a finger stays as slim as it is where it moves with its hand."""
        assert self.whole_rest_surface is not None
        return self.whole_rest_surface


def restricted(body: BodyModel, names: Collection[str]) -> BodyModel:
    """The body with some of its joints and the root; the skin of the others moves with these.

    The vertices are those of the whole body with the other joints at rest: to a joint that is not
    turned relative to its parent, its skin may as well belong to that parent.

    Example:
        >>> from spt_jax import load_body
        >>> from spt_jax.datasets.restricted import restricted
        >>> restricted(load_body(), ["left_hip", "left_knee"]).joint_names
        ('pelvis', 'left_hip', 'left_knee')
    """
    kept = [k for k, name in enumerate(body.joint_names) if k == 0 or name in names]
    if len(kept) == body.num_joints:
        return body
    owner: list[int] = []  # of each joint, the row of the kept one that it moves with
    for k in range(body.num_joints):
        owner.append(kept.index(k) if k in kept else owner[body.parents[k]])
    merged = np.zeros((body.num_joints, len(kept)))
    merged[np.arange(body.num_joints), owner] = 1.0
    rows = jnp.asarray(kept)
    basis = body.pose_basis
    columns = feature_columns(body.pose_features, np.array(kept), body.num_joints)
    expression = body.joint_expression_basis
    return RestrictedBody(
        template=body.template,
        shape_basis=body.shape_basis,
        joint_template=body.joint_template[rows],
        joint_shape_basis=body.joint_shape_basis[rows],
        weights=body.weights @ jnp.asarray(merged, body.weights.dtype),
        faces=body.faces,
        parents=(-1, *(owner[body.parents[k]] for k in kept[1:])),
        joint_names=tuple(body.joint_names[k] for k in kept),
        pose_basis=None if basis is None else basis[..., jnp.asarray(columns)],
        expression_basis=body.expression_basis,
        joint_expression_basis=None if expression is None else expression[rows],
        pose_features=body.pose_features,
        whole_rest_surface=body.rest_surface,
    )
