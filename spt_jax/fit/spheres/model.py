"""A body approximated by spheres, the paper's rival "RE + SA", at rest and in poses.

How far they collide is in `penalty.py`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from spt_jax.body import BodyModel
from spt_jax.body.rotations import matrix_from_axis_angle
from spt_jax.body.skinning import blend_shapes, forward_kinematics, lift
from spt_jax.fit.spheres.fitting import Rest, fit_spheres
from spt_jax.fit.spheres.surface_samples import sample_surface


class PosedSpheres(NamedTuple):
    """Spheres of a posed body: `centers` (..., S, 3) and `radii` (..., S), in metres."""

    centers: Float[Array, "*batch S 3"]
    radii: Float[Array, "*batch S"]


class Coverage(NamedTuple):
    """How well spheres fill a body, as parts of its volume.

    Attributes:
        covered: of the body that lies in some sphere.
        outside: of the spheres' union that lies outside of the body.
    """

    covered: float
    outside: float


class BodySpheres(eqx.Module):
    """Spheres that approximate a body's interior, each carried rigidly by one joint.

    The coarse approximation of Pons-Moll et al. 2015, which the paper compares with; the spheres
    follow the shape, linearly, and leave out pose blend shapes. Make them with `fit`, once and
    outside `jit`; they are a pytree.

    Attributes:
        centers: at rest, of the mean shape, in metres.
        center_shape_basis: displacement of each center for one unit of each shape coefficient.
        radii: of the mean shape, in metres.
        radius_shape_basis: change of each radius likewise.
        counts: which pairs may collide; true above the diagonal only. Left out are spheres of one
            part, of parent and child, those that overlap at rest in the mean shape, and those
            nearer to each other along the limbs than the fold distance.
        part: the joint that carries each sphere.

    Example:
        >>> from spt_jax import load_body
        >>> from spt_jax.fit.spheres.model import BodySpheres
        >>> spheres = BodySpheres.fit(load_body())
        >>> len(spheres.part)
        114
    """

    centers: Float[Array, "S 3"]
    center_shape_basis: Float[Array, "S 3 B"]
    radii: Float[Array, "S"]
    radius_shape_basis: Float[Array, "S B"]
    counts: Bool[Array, "S S"]
    part: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def fit(
        cls, body: BodyModel, *, share: float = 0.9, fold_distance: float = 0.3
    ) -> "BodySpheres":
        """Spheres for any body, from its rest surface and its parts (`body.part_groups`) alone.

        Part by part, the sphere that covers most of the part's volume not covered yet, less what
        it covers outside of the body, until `share` is covered or a sphere would add less than
        4 % of the part or 0.02 % of the body. Fitted in 1.4 s on one core and kept: another call
        with the same body takes 15 ms. The embedded body gets 114 spheres, 30 of them in the
        fingers; they hold 90 % of its volume, and another 6 % lies in them outside of it
        (`coverage`); their surface is 6 mm from the skin on average.

        Args:
            body: any `BodyModel` whose surface encloses a volume.
            share: of each part's volume to cover, above 0 and at most 1.
            fold_distance: in metres. Spheres nearer than this along the limbs, over the joints
                between them, come together whenever a joint bends: the rule for folds of
                `body.rest_surface`, here for spheres. Without it (0.0) 93 % of the mocap frames
                whose skin does not intersect collide, thigh with belly above all; with it 1 %.

        Raises:
            TypeError: the body is traced.
            ValueError: a share or distance out of range; a body without an inside.
        """
        if isinstance(body.template, Tracer):
            raise TypeError(
                "body must be known: got a traced one; fit the spheres outside jit, vmap and grad, "
                "and pass them in."
            )
        if not 0 < share <= 1:
            raise ValueError(f"share must be above 0 and at most 1: got {share!r}.")
        if not 0 <= fold_distance < np.inf:
            raise ValueError(
                f"fold_distance must be finite and not negative: got {fold_distance!r}."
            )
        found = fit_spheres(
            Rest(
                vertices=np.asarray(body.template, np.float64),
                faces=np.asarray(body.faces, np.int64),
                groups=np.asarray(body.part_groups, np.int64),
                joints=np.asarray(body.joint_template, np.float64),
                parents=body.parents,
                shape_basis=np.asarray(body.shape_basis, np.float64),
                share=float(share),
                fold_distance=float(fold_distance),
            )
        )
        if not len(found.part):
            raise ValueError(
                "body must enclose a volume: got no point inside; check_mesh(body.template, "
                "body.faces) says what is wrong with the surface."
            )
        dtype = body.template.dtype
        return cls(
            centers=jnp.asarray(found.centers, dtype),
            center_shape_basis=jnp.asarray(found.center_shape_basis, dtype),
            radii=jnp.asarray(found.radii, dtype),
            radius_shape_basis=jnp.asarray(found.radius_shape_basis, dtype),
            counts=jnp.asarray(found.counts),
            part=tuple(found.part.tolist()),
        )

    @property
    def pairs(self) -> Int[np.ndarray, "P 2"]:
        """The pairs of spheres that may collide, outside `jit`."""
        return np.argwhere(np.asarray(self.counts))

    def posed(
        self,
        body: BodyModel,
        pose: Float[Array | np.ndarray, "*#batch J 3"],
        shape: Float[Array | np.ndarray, "*#batch B"] | None = None,
        translation: Float[Array | np.ndarray, "*#batch 3"] | None = None,
    ) -> PosedSpheres:
        """The spheres of the body in a pose; no vertex is skinned.

        Args:
            body: the body that they were fitted to.
            pose, shape, translation: as the body takes them.

        Returns:
            PosedSpheres(centers, radii), in the dtype of `pose`.

        Raises:
            TypeError, ValueError: as the body does.

        Differentiation: every mode, with respect to the arguments and to the arrays of both.

        Example:
            >>> import jax.numpy as jnp
            >>> from spt_jax import load_body
            >>> from spt_jax.fit.spheres.model import BodySpheres
            >>> body = load_body()
            >>> BodySpheres.fit(body).posed(body, jnp.zeros((8, 52, 3))).centers.shape
            (8, 114, 3)
        """
        angles, betas = as_arguments(body, pose, shape)
        shift = jnp.zeros(3) if translation is None else jnp.asarray(translation)
        if shift.ndim < 1 or shift.shape[-1] != 3:
            raise ValueError(f"translation must be (..., 3): got shape {shift.shape}.")
        shift = shift.astype(angles.dtype)
        centers, radii = posed_on(self, Tree(body), angles, betas)
        rank = max(centers.ndim - 2, shift.ndim - 1)
        centers = lift(centers, rank, 2) + lift(shift, rank, 1)[..., None, :]
        return PosedSpheres(centers, jnp.broadcast_to(lift(radii, rank, 1), centers.shape[:-1]))

    def coverage(
        self, body: BodyModel, shape: Float[Array | np.ndarray, "B"] | None = None
    ) -> Coverage:
        """How well the spheres fill the body at rest, by 200,000 samples, outside `jit`.

        Args:
            body: the body that they were fitted to.
            shape: coefficients, the mean where None.

        Example:
            >>> from spt_jax import load_body
            >>> from spt_jax.fit.spheres.model import BodySpheres
            >>> body = load_body()
            >>> covered, outside = BodySpheres.fit(body).coverage(body)
            >>> bool(covered > 0.88 and outside < 0.07)
            True
        """
        vertices = np.asarray(body.rest(shape), np.float64)
        pose = jnp.zeros((body.num_joints, 3), body.template.dtype)
        centers, radii = (np.asarray(x, np.float64) for x in self.posed(body, pose, shape))
        low = np.minimum(vertices.min(axis=0), (centers - radii[:, None]).min(axis=0))
        high = np.maximum(vertices.max(axis=0), (centers + radii[:, None]).max(axis=0))
        points = np.random.default_rng(0).uniform(low, high, (200_000, 3))
        held = np.zeros(len(points), bool)
        for center, radius in zip(centers, radii, strict=True):
            held |= ((points - center) ** 2).sum(axis=1) < radius**2
        surface = sample_surface(vertices, np.asarray(body.faces, np.int64))
        # Only what spheres hold is looked up: a search from far outside is slow.
        inside = int(surface.inside(points[held])[0].sum())
        each = (high - low).prod() / len(points) / surface.volume
        return Coverage(float(inside * each), float((held.sum() - inside) * each))


class Tree(eqx.Module):
    """The joints of a body: all that its spheres need, so that jit is not handed its surface."""

    joints: Float[Array, "J 3"]
    basis: Float[Array, "J 3 B"]
    parents: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, body: BodyModel):
        self.joints, self.basis = body.joint_template, body.joint_shape_basis
        self.parents = body.parents


@jax.jit
def posed_on(spheres: BodySpheres, tree: Tree, angles, betas):
    """Centers and radii of the spheres in a pose, without a translation."""
    dtype = angles.dtype
    rank = max(angles.ndim - 2, 0 if betas is None else betas.ndim - 1)
    joints, centers, radii = at_rest(spheres, tree, betas, dtype)
    rotations = lift(matrix_from_axis_angle(angles), rank, 3)
    joints, centers, radii = lift(joints, rank, 2), lift(centers, rank, 2), lift(radii, rank, 1)
    world, positions = forward_kinematics(rotations, joints, tree.parents)
    part = np.array(spheres.part)
    arm = (centers - joints[..., part, :])[..., None, :]
    turned = jnp.sum(world[..., part, :, :] * arm, axis=-1)
    return positions[..., part, :] + turned, radii


def at_rest(spheres: BodySpheres, tree: Tree, betas, dtype):
    """Joints, centers and radii of the body at rest in a shape."""
    joints = blend_shapes(tree.joints, tree.basis, betas, dtype)
    centers = blend_shapes(spheres.centers, spheres.center_shape_basis, betas, dtype)
    radii = spheres.radii.astype(dtype)
    if betas is not None:
        basis = spheres.radius_shape_basis[:, : betas.shape[-1]].astype(dtype)
        change = jnp.einsum("sb,...b->...s", basis, betas, precision=jax.lax.Precision.HIGHEST)
        radii = lift(radii, betas.ndim - 1, 1) + change
    return joints, centers, jnp.maximum(radii, 0.0)


def as_arguments(body: BodyModel, pose, shape):
    """Pose and shape, checked against the body; no shape stays None."""
    angles = jnp.asarray(pose)
    if not jnp.issubdtype(angles.dtype, jnp.floating):
        raise TypeError(f"pose must be floating-point: got dtype {angles.dtype}.")
    if angles.ndim < 2 or angles.shape[-2:] != (body.num_joints, 3):
        raise ValueError(
            f"pose must be (..., {body.num_joints}, 3), one axis-angle row a joint: got shape "
            f"{angles.shape}; for SMPL's layouts use body.pose_from_smpl(pose)."
        )
    if shape is None:
        return angles, None
    betas = jnp.asarray(shape)
    if not jnp.issubdtype(betas.dtype, jnp.floating):
        raise TypeError(f"shape must be floating-point: got dtype {betas.dtype}.")
    if betas.ndim < 1 or betas.shape[-1] > body.num_shape:
        raise ValueError(
            f"shape must have at most {body.num_shape} coefficients in its last axis: got shape "
            f"{betas.shape}; drop the last ones."
        )
    return angles, betas.astype(angles.dtype)
