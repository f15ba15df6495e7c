"""Vertices of the face, the ears and the feet, where keypoints lie that no joint gives."""

import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from spt_jax.body import BodyModel

#: The landmarks that every body has.
LANDMARKS = (
    *("nose", "left_eye", "right_eye", "left_ear", "right_ear", "head_top"),
    *("left_big_toe", "left_small_toe", "left_heel"),
    *("right_big_toe", "right_small_toe", "right_heel"),
)

# By number of vertices; as in https://github.com/vchoutas/smplx, smplx/vertex_ids.py.
_OFFICIAL = {
    6890: {  # SMPL and SMPL-H
        **{"nose": 332, "left_eye": 2800, "right_eye": 6260, "left_ear": 583, "right_ear": 4071},
        **{"left_big_toe": 3216, "left_small_toe": 3226, "left_heel": 3387},
        **{"right_big_toe": 6617, "right_small_toe": 6624, "right_heel": 6787},
    },
    10475: {  # SMPL-X
        **{"nose": 9120, "left_eye": 9448, "right_eye": 9929, "left_ear": 6, "right_ear": 616},
        **{"left_big_toe": 5770, "left_small_toe": 5780, "left_heel": 8846},
        **{"right_big_toe": 8463, "right_small_toe": 8474, "right_heel": 8635},
    },
}

_FINGERS = ("thumb", "index", "middle", "ring", "pinky")
#: The ends of the fingers, of bodies that have fingers.
FINGERTIPS = tuple(f"{side}_{finger}_tip" for side in ("left", "right") for finger in _FINGERS)

# As _OFFICIAL, in the order of FINGERTIPS.
_OFFICIAL_TIPS = {
    6890: (2746, 2319, 2445, 2556, 2673, 6191, 5782, 5905, 6016, 6133),
    10475: (5361, 4933, 5058, 5169, 5286, 8079, 7669, 7794, 7905, 8022),
}

# The eyes' height above the tip of the nose, per distance from there to the top of the head, and
# their distance from the middle, per half of the head's width over the ears. So they lie on the
# embedded body; people's are 63 mm apart on a width of 185 mm, 0.34 too.
_EYE_HEIGHT, _EYE_SIDE = 0.24, 0.34


def find_landmarks(body: BodyModel) -> dict[str, int]:
    """The vertex of each landmark of a body.

    SMPL, SMPL-H and SMPL-X, known by their 6,890 and 10,475 vertices, have official ones, but for
    the top of the head. On any other body, and for that, they are found on the rest surface, which
    stands upright along y, faces z and has its left at +x, among the vertices that the head or a
    foot moves:

        nose                the foremost of the head near its mid-plane
        head_top            the highest of the head near its mid-plane
        eyes                the nearest, seen from the front, to fixed proportions of nose, top and
                            width
        ears                the middle of the outermost tenth of the head
        big toes            the foremost of the foot
        small toes          the foremost of the foot's outer border
        heels               the hindmost of the foot near the ground

    Args:
        body: the body; its template and skinning weights are read.

    Returns:
        A vertex index for each of LANDMARKS.

    Raises:
        TypeError: inside jit, grad or vmap of a function that the body is an argument of.
        ValueError: the body has no joint, or no vertices, for a head or a foot.

    Example:
        >>> from spt_jax.body import load_body
        >>> from spt_jax.keypoints.landmarks import find_landmarks
        >>> body = load_body()
        >>> found = find_landmarks(body)
        >>> bool(body.template[found["left_eye"], 0] > body.template[found["nose"], 0])
        True
    """
    if isinstance(body.template, Tracer) or isinstance(body.weights, Tracer):
        raise TypeError(
            "body must be known: got a traced body; find its landmarks, or make its keypoint "
            "regressor, outside jit, grad and vmap."
        )
    vertices = np.asarray(body.template, np.float64)
    found = _of_the_head(body, vertices)
    for side, outward in (("left", 1.0), ("right", -1.0)):
        found |= _of_the_foot(body, vertices, side, outward)
    found |= _OFFICIAL.get(len(vertices), {})
    return {name: found[name] for name in LANDMARKS}


def find_fingertips(body: BodyModel) -> dict[str, int]:
    """The vertices at the ends of the fingers that a body has.

    SMPL-H's and SMPL-X's are official, known by their numbers of vertices. On any other body it is
    the vertex farthest from a finger's last joint, in the direction that the finger points at rest,
    among those that the joint moves.

    Args:
        body: the body; its template, joints and skinning weights are read.

    Returns:
        A vertex index for those of FINGERTIPS whose finger has its last two joints; none for SMPL.

    Raises:
        TypeError: inside jit, grad or vmap of a function that the body is an argument of.

    Example:
        >>> from spt_jax.body import load_body
        >>> from spt_jax.keypoints.landmarks import find_fingertips
        >>> len(find_fingertips(load_body()))
        10
    """
    if isinstance(body.template, Tracer) or isinstance(body.weights, Tracer):
        raise TypeError(
            "body must be known: got a traced body; find its fingertips outside jit, grad and vmap."
        )
    vertices, found = np.asarray(body.template, np.float64), {}
    official = dict(zip(FINGERTIPS, _OFFICIAL_TIPS.get(len(vertices), ()), strict=False))
    for tip in FINGERTIPS:
        before, last = (tip.replace("_tip", number) for number in ("2", "3"))
        if before not in body.joint_names or last not in body.joint_names:
            continue
        at = [
            np.asarray(body.joint_template)[body.joint_names.index(name)] for name in (before, last)
        ]
        rows = np.flatnonzero(np.asarray(body.weights)[:, body.joint_names.index(last)] > 0.5)
        if tip in official:
            found[tip] = official[tip]
        elif rows.size:
            found[tip] = int(rows[np.argmax((vertices[rows] - at[1]) @ (at[1] - at[0]))])
    return found


def _of_the_head(body: BodyModel, vertices: Float[np.ndarray, "V 3"]) -> dict[str, int]:
    rows = _moved_by(body, ("head", "jaw", "left_eye", "right_eye"), "head")
    head = vertices[rows]
    low, high = head.min(axis=0), head.max(axis=0)
    middle, half = (low[0] + high[0]) / 2, (high[0] - low[0]) / 2
    # Of a coarse mesh at least the vertex nearest to the mid-plane.
    aside = np.abs(head[:, 0] - middle)
    central = aside <= max(0.1 * half, aside.min())
    nose = _best(head[:, 2], central)
    top = _best(head[:, 1], central)
    rise = head[top, 1] - head[nose, 1]
    found = {"nose": nose, "head_top": top}
    for side, outward in (("left", half), ("right", -half)):
        eye = middle + _EYE_SIDE * outward, head[nose, 1] + _EYE_HEIGHT * rise
        away = np.linalg.norm(head[:, :2] - eye, axis=1)
        # Behind an eye lie its socket (the embedded body's are hollow, 3 cm deep) and the back of
        # the head: what counts is within a twentieth of the head's depth of the foremost there.
        around = away <= max(0.12 * abs(outward), away.min())
        front = head[:, 2] >= head[around, 2].max() - 0.05 * (high[2] - low[2])
        found[f"{side}_eye"] = _best(-away, around & front)
        # The middle of what stands out, across: the outermost vertex alone is the ear's rim.
        ear = (head[:, 0] - middle) / outward >= 0.9
        center = (head[ear, 1:].min(axis=0) + head[ear, 1:].max(axis=0)) / 2
        found[f"{side}_ear"] = _best(-np.linalg.norm(head[:, 1:] - center, axis=1), ear)
    return {name: int(rows[k]) for name, k in found.items()}


def _of_the_foot(
    body: BodyModel, vertices: Float[np.ndarray, "V 3"], side: str, outward: float
) -> dict[str, int]:
    rows = _moved_by(body, (f"{side}_ankle", f"{side}_foot"), f"{side}_ankle")
    foot = vertices[rows]
    low, high = foot.min(axis=0), foot.max(axis=0)
    across = outward * foot[:, 0]
    width = across.max() - across.min()
    sole = foot[:, 1] <= low[1] + 0.3 * (high[1] - low[1])
    found = {
        "big_toe": _best(foot[:, 2]),
        "small_toe": _best(foot[:, 2], across >= across.max() - 0.15 * width),
        "heel": _best(-foot[:, 2], sole),
    }
    return {f"{side}_{name}": int(rows[k]) for name, k in found.items()}


def _moved_by(body: BodyModel, joints: tuple[str, ...], needed: str) -> np.ndarray:
    """The vertices that these joints move for more than a half."""
    if needed not in body.joint_names:
        raise ValueError(
            f"body must have a joint {needed!r} for its landmarks to be found: got "
            f"{', '.join(body.joint_names)}; name keypoints that are joints of the body."
        )
    columns = [k for k, name in enumerate(body.joint_names) if name in joints]
    rows = np.flatnonzero(np.asarray(body.weights)[:, columns].sum(axis=1) > 0.5)
    if rows.size == 0:
        raise ValueError(
            f"body must have vertices that {' and '.join(joints)} move for more than a half: got "
            "none; its landmarks cannot be found. Name keypoints that are joints of the body."
        )
    return rows


def _best(score: np.ndarray, allowed: np.ndarray | None = None) -> int:
    return int(np.argmax(score if allowed is None else np.where(allowed, score, -np.inf)))
