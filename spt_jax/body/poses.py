"""The joint layouts of the SMPL family, and poses carried from one of them to any body by name."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_BODY = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2"),
    *("left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck"),
    *("left_collar", "right_collar", "head", "left_shoulder", "right_shoulder"),
    *("left_elbow", "right_elbow", "left_wrist", "right_wrist"),
)
FINGERS = tuple(
    f"{side}_{finger}{knuckle}"
    for side in ("left", "right")
    for finger in ("index", "middle", "pinky", "ring", "thumb")
    for knuckle in (1, 2, 3)
)

#: Joint names by number of joints: motion capture's 22, SMPL's 24, SMPL-H's 52, SMPL-X's 55.
SMPL_LAYOUTS: dict[int, tuple[str, ...]] = {
    22: _BODY,
    24: (*_BODY, "left_hand", "right_hand"),
    52: (*_BODY, *FINGERS),
    55: (*_BODY, "jaw", "left_eye", "right_eye", *FINGERS),
}


def pose_from_smpl(
    pose: Float[Array | np.ndarray, "..."], joint_names: tuple[str, ...]
) -> Float[Array, "*batch J 3"]:
    """A pose of `joint_names`' joints from a pose of the SMPL family.

    Rotations are copied by joint name. Joints that the pose lacks stay at rest; joints of the pose
    that are not in `joint_names` (on the embedded body SMPL-X's jaw and eyes, and SMPL's two
    lumped hand joints) are dropped.

    Args:
        pose: axis-angle, in radians, of 22 (body), 24 (SMPL), 52 (SMPL-H) or 55 (SMPL-X) joints:
            (..., joints, 3), or flat (..., 66), (..., 72), (..., 156) or (..., 165).
        joint_names: the joints to fill.

    Returns:
        One row for each of `joint_names`, in the dtype of `pose`.

    Raises:
        TypeError: `pose` is not floating-point.
        ValueError: `pose` has none of the shapes above.

    Differentiation: every mode; the map is linear.

    Example:
        >>> import numpy as np
        >>> from spt_jax.body.poses import pose_from_smpl
        >>> pose_from_smpl(np.ones((7, 72), np.float32), ("pelvis", "jaw"))[0].tolist()
        [[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]
    """
    array = jnp.asarray(pose)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        raise TypeError(
            f"pose must be floating-point, in radians: got dtype {array.dtype}; "
            "convert it with pose.astype('float32')."
        )
    if array.ndim >= 2 and array.shape[-1] == 3 and array.shape[-2] in SMPL_LAYOUTS:
        layout = SMPL_LAYOUTS[array.shape[-2]]
    elif array.ndim >= 1 and array.shape[-1] in {3 * count for count in SMPL_LAYOUTS}:
        layout = SMPL_LAYOUTS[array.shape[-1] // 3]
        array = array.reshape(*array.shape[:-1], len(layout), 3)
    else:
        raise ValueError(
            "pose must hold 22, 24, 52 or 55 joints, as (..., joints, 3) or flat as "
            f"(..., 3 * joints): got shape {tuple(array.shape)}; cut or pad it to one of SMPL's "
            "layouts."
        )
    rest = jnp.zeros((*array.shape[:-2], 1, 3), array.dtype)
    rows = [layout.index(name) if name in layout else len(layout) for name in joint_names]
    return jnp.concatenate([array, rest], axis=-2)[..., np.array(rows), :]
