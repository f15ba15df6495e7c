"""Expressions as shape coefficients, for what takes a pose and a shape."""

import jax.numpy as jnp

from spt_jax.body.model import BodyModel


def expression_as_shape(body: BodyModel) -> BodyModel:
    """The same body whose expressions are further shape coefficients, after those of the shape.

    What takes a pose and a shape (`untangle_pose`, `untangle_motion`, `BodyGroup`) holds a face so.

    Returns:
        A body with `num_shape + num_expression` shape coefficients and no expressions; the same
        object where there are none.

    Differentiation: every mode, with respect to the body's arrays.

    Example:
        >>> from spt_jax.body import expression_as_shape, load_body
        >>> body = load_body().replaced(
        ...     {"expression_basis": load_body().shape_basis[..., :3],
        ...      "joint_expression_basis": load_body().joint_shape_basis[..., :3]}
        ... )
        >>> body.num_shape, body.num_expression, expression_as_shape(body).num_shape
        (10, 3, 13)
    """
    if body.expression_basis is None or body.joint_expression_basis is None:
        return body
    joints = jnp.concatenate([body.joint_shape_basis, body.joint_expression_basis], axis=-1)
    return body.replaced(
        {
            "shape_basis": jnp.concatenate([body.shape_basis, body.expression_basis], axis=-1),
            "joint_shape_basis": joints,
            "expression_basis": None,
            "joint_expression_basis": None,
        }
    )
