"""The models whose files are read, how files are recognized, and the names of the joints."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spt_jax.body.poses import FINGERS, SMPL_LAYOUTS
from spt_jax.body.posing import PoseFeatures, count_features

# benjiebob/SMALify and later readers of the model agree on these; the two ears are in its later
# releases (35 joints).
_SMAL = (
    *("pelvis", "pelvis0", "spine", "spine0", "spine1", "spine2", "spine3"),
    *("left_front_leg1", "left_front_leg2", "left_front_leg3", "left_front_foot"),
    *("right_front_leg1", "right_front_leg2", "right_front_leg3", "right_front_foot"),
    *("neck", "head"),
    *("left_back_leg1", "left_back_leg2", "left_back_leg3", "left_back_foot"),
    *("right_back_leg1", "right_back_leg2", "right_back_leg3", "right_back_foot"),
    *(f"tail{k}" for k in range(1, 8)),
    *("mouth", "left_ear", "right_ear"),
)


class Layout(NamedTuple):
    """What a model's files hold.

    Attributes:
        name: of the model.
        names: of its joints.
        features: what its pose blend shapes go by.
        expressions: of so many shape components, how many are the shape's; those of the expression
            stand behind them. In files of another number all are the shape's.
    """

    name: str
    names: tuple[str, ...]
    features: PoseFeatures = "matrices"
    expressions: Mapping[int, int] = {}


# SUPR's code names no joint, so they are called by number.
_LAYOUTS = (
    Layout("SMPL", SMPL_LAYOUTS[24]),
    Layout("STAR", SMPL_LAYOUTS[24], "star"),
    Layout("SMPL-H", SMPL_LAYOUTS[52]),
    # 300 + 100 components, or 10 + 10 in its small files.
    Layout("SMPL-X", SMPL_LAYOUTS[55], expressions={400: 300, 20: 10}),
    Layout("MANO", ("right_wrist", *(name for name in FINGERS if name.startswith("right")))),
    Layout("FLAME", ("head", "neck", "jaw", "left_eye", "right_eye"), expressions={400: 300}),
    Layout("SMAL", _SMAL[:33]),
    Layout("SMAL", _SMAL),
    Layout("SUPR", tuple(f"joint{k}" for k in range(75)), "quaternions"),
)
"""All known models; of two with the same number of joints, the pose blend shapes decide."""


def layout_of(arrays: Mapping[str, np.ndarray], path: Path) -> Layout:
    """Which model a file's arrays are: by its joints, and by what its pose blend shapes go by.

    Raises:
        ValueError: none that is known.
    """
    joints = arrays["weights"].shape[1]
    columns = arrays["posedirs"].shape[-1] if "posedirs" in arrays else None
    for layout in _LAYOUTS:
        expected = count_features(layout.features, joints)
        if len(layout.names) == joints and columns in (None, expected):
            return _of_side(arrays, path) if layout.name == "MANO" else layout
    with_blends = "" if columns is None else f" and {columns} components in posedirs"
    known = ", ".join(
        f"{layout.name} ({len(layout.names)} joints, "
        f"{count_features(layout.features, len(layout.names))} components)"
        for layout in _LAYOUTS
    )
    raise ValueError(
        f"{path} must be a model that is known, {known}: got {joints} joints{with_blends}; of "
        "another model, make a BodyModel of its arrays."
    )


def _of_side(arrays: Mapping[str, np.ndarray], path: Path) -> Layout:
    """A MANO file's hand: as its name says, else by the way in which its fingers point."""
    name = path.stem.lower()
    if ("left" in name) != ("right" in name):
        side = "left" if "left" in name else "right"
    else:
        # At rest SMPL's left hand lies along x, its right one against it.
        x = np.asarray(arrays["J_regressor"], np.float64) @ arrays["v_template"][:, 0]
        side = "left" if x[1:].mean() > x[0] else "right"
    return Layout("MANO", (f"{side}_wrist", *(name for name in FINGERS if name.startswith(side))))
