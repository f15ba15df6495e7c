"""Poses in parts: the keywords of the `smplx` package, of SMPLify-X and of VPoser.

`global_orient` and `body_pose` (vchoutas/smplx, smplx/body_models.py), or `root_orient` and
`pose_body` (nghorbani/human_body_prior, src/human_body_prior/body_model/body_model.py), with hands
and face beside them. Nearly every structure has one of these at its heart.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from spt_jax.io.poses.rotations import Form
from spt_jax.io.poses.source import MOST_SHAPE, Block, Source, Way, spelt
from spt_jax.io.poses.track import Track

ROOT = ("global_orient", "root_orient")
BODY = ("body_pose", "pose_body")
TRANSLATION = ("trans", "transl", "translation", "Th")
SHAPE = ("betas", "shape", "shapes")
RATE = ("mocap_framerate", "mocap_frame_rate", "frame_rate", "fps")
GENDER = ("gender", "surface_model_gender")
_EXPRESSION = ("expression",)
_JAW, _EYES = ("jaw_pose", "pose_jaw"), ("pose_eye",)
_LEFT_EYE, _RIGHT_EYE = ("leye_pose",), ("reye_pose",)
_LEFT_HAND, _RIGHT_HAND = ("left_hand_pose",), ("right_hand_pose",)
_HANDS = ("pose_hand",)
_VPOSER = 32
_MOST_COMPONENTS = 45


class Parts(NamedTuple):
    """Parts put together: the pose, where its parts stand, and hands that are components."""

    pose: Float[np.ndarray, "N J 3"]
    blocks: tuple[Block, ...]
    left_hand: Float[np.ndarray, "N C"] | None = None
    right_hand: Float[np.ndarray, "N C"] | None = None


def has_parts(source: Source, at: Way = ()) -> bool:
    """Whether there is a body in parts."""
    return source.first(at, ROOT) is not None and source.first(at, BODY) is not None


def read_parts(source: Source, at: Way = (), index: tuple[Any, ...] = ()) -> Parts:
    """The body in parts at a place of the file.

    Args:
        at: the way to the dictionary of the parts.
        index: of one person, where arrays hold several.

    Raises:
        ValueError: parts are missing, have another shape, or do not go together.
    """
    body_way, root_way = source.first(at, BODY), source.first(at, ROOT)
    if body_way is None or root_way is None:
        raise ValueError(
            f"pose file must hold global_orient with body_pose: got {source.file!r} with one of "
            "them alone"
        )
    body = _body(source, body_way, index)
    found = [_part(source, root_way, (0,), index, len(body[0]), body[1].form), body]
    count = 1 + body[0].shape[1]
    hands = [source.first(at, names) for names in (_LEFT_HAND, _RIGHT_HAND, _HANDS)]
    head = [source.first(at, names) for names in (_JAW, _LEFT_EYE, _RIGHT_EYE, _EYES)]
    if (any(hands) or any(head)) and count != 22:
        if any(way is not None and source.numbers(way, index).any() for way in (*hands, *head)):
            raise ValueError(
                f"{spelt(body_way)} must hold 21 rows beside separate hands or face: got "
                f"{count - 1} in {source.file!r}; SMPL's last two rows are its hands"
            )
        hands, head = [], []
    components: dict[str, Any] = {}
    if any(hands) or any(head):
        count = 55 if any(head) else 52
        places = _places(count)
        for name, way in zip(("left", "right", "both"), hands, strict=True):
            if way is None:
                continue
            part = source.rotations(way, places[name], index=index)
            if part is None:
                components[name] = _components(source, way, index, name)
            else:
                found.append(part)
        for name, way in zip(("jaw", "left eye", "right eye", "eyes"), head, strict=True):
            if way is not None:
                found.append(_part(source, way, places[name], index, None, None))
        if components and count == 52 and len(found) == 2:
            count = 22
    return _joined(source, found, count, components)


def _places(count: int) -> dict[str, tuple[int, ...]]:
    start = count - 30
    return {
        "left": tuple(range(start, start + 15)),
        "right": tuple(range(start + 15, start + 30)),
        "both": tuple(range(start, start + 30)),
        "jaw": (22,),
        "left eye": (23,),
        "right eye": (24,),
        "eyes": (23, 24),
    }


def _body(source: Source, way: Way, index: tuple[Any, ...]) -> tuple[np.ndarray, Block]:
    for count in (21, 23):
        found = source.rotations(way, range(1, count + 1), index=index)
        if found is not None:
            return found
    values = source.numbers(way, index)
    if values.shape[-1:] == (_VPOSER,):
        raise ValueError(
            f"{spelt(way)} must hold rotations: got a code of VPoser, shape {values.shape}, in "
            f"{source.file!r}; decode it with the network that made it (human_body_prior's "
            "vposer.decode) and write the result as body_pose"
        )
    raise ValueError(
        f"{spelt(way)} must hold frames of 21 or 23 rotations, as axis-angle (N, J, 3) or "
        f"(N, 3 J), matrices, 6D or quaternions: got shape {values.shape} in {source.file!r}"
    )


def _part(
    source: Source,
    way: Way,
    joints: tuple[int, ...],
    index: tuple[Any, ...],
    frames: int | None,
    form: Form | None,
) -> tuple[np.ndarray, Block]:
    found = None
    # (3, 3) may be three vectors or one matrix, and which of four numbers is the scalar shows best
    # in many joints: the body says.
    for some in (frames, None):
        if form is not None and found is None:
            found = source.rotations(way, joints, index=index, frames=some, forms=(form,))
    found = found or source.rotations(way, joints, index=index)
    if found is None:
        shape = source.numbers(way, index).shape
        raise ValueError(
            f"{spelt(way)} must hold frames of {len(joints)} rotation{'s' * (len(joints) > 1)}: "
            f"got shape {shape} in {source.file!r}"
        )
    return found


def _components(source: Source, way: Way, index: tuple[Any, ...], side: str) -> np.ndarray:
    values = np.atleast_2d(source.numbers(way, index))
    if values.ndim != 2 or not 0 < values.shape[1] <= _MOST_COMPONENTS or side == "both":
        raise ValueError(
            f"{spelt(way)} must hold frames of 15 rotations, or 1 to {_MOST_COMPONENTS} components "
            f"of a hand: got shape {values.shape} in {source.file!r}"
        )
    source.note(
        f"{spelt(way)} is {values.shape[1]} components of MANO's hand, which a body that has "
        "hand components turns into rotations"
    )
    return values


def _joined(source: Source, found: list, count: int, components: dict[str, Any]) -> Parts:
    names = [spelt(block.way) for _, block in found] + [f"{side} hand" for side in components]
    lengths = [len(values) for values, _ in found] + [len(v) for v in components.values()]
    frames = max(lengths)
    if any(length not in (1, frames) for length in lengths):
        raise ValueError(
            f"{', '.join(names)} must have one number of frames: got {lengths} in {source.file!r}"
        )
    pose = np.zeros((frames, count, 3))
    for values, block in found:
        pose[:, block.joints] = values
    hands = {
        f"{side}_hand": np.broadcast_to(v, (frames, v.shape[1])) for side, v in components.items()
    }
    return Parts(pose, tuple(block for _, block in found), **hands)


def track_of(
    source: Source,
    name: str,
    pose: np.ndarray,
    blocks: tuple[Block, ...],
    at: Way = (),
    **given: Any,
) -> Track:
    """A track with what stands beside its pose: translation, shape, rate, gender, expression.

    Args:
        at: the way to the dictionary in which these stand.
        given: of `Track`; what is given is not looked for.

    Raises:
        ValueError: one of them has another shape.
    """
    frames = len(pose)
    made: dict[str, Any] = dict(given)
    if "translation" not in made:
        made["translation"] = source.translation(source.first(at, TRANSLATION), frames)
    if "shape" not in made:
        made["shape"] = source.shape(source.first(at, SHAPE), frames)
    if "frame_rate" not in made:
        made["frame_rate"] = source.frame_rate(source.first(at, RATE))
    if "gender" not in made:
        made["gender"] = source.gender(source.first(at, GENDER))
    if "expression" not in made:
        way = source.first(at, _EXPRESSION)
        values = None if way is None else np.atleast_2d(source.numbers(way, most=MOST_SHAPE))
        if values is not None and values.shape[:-1] in ((1,), (frames,)):
            made["expression"] = np.broadcast_to(values, (frames, values.shape[1]))
    return Track(name, pose, blocks=blocks, **made)


def parts_track(source: Source, name: str, at: Way = (), **given: Any) -> Track:
    """The track of a body in parts."""
    parts = read_parts(source, at)
    track = track_of(source, name, parts.pose, parts.blocks, at, **given)
    return replace(track, left_hand=parts.left_hand, right_hand=parts.right_hand)


def read_in_parts(source: Source) -> list[Track]:
    """SMPLify-X, PROX, HMR2 and VPoser's parts: one dictionary of parts, one person.

    SMPLify-X writes the parameters of its model and camera (vchoutas/smplify-x,
    smplifyx/fit_single_frame.py); with VPoser `body_pose` is its code there. PROX adds `transl`
    (mohamedhassanmus/prox, prox/fit_single_frame.py). HMR2 returns matrices,
    in a dictionary `pred_smpl_params` (shubham-goel/4D-Humans, hmr2/models/hmr2.py).
    """
    at = ("pred_smpl_params",)
    return [parts_track(source, source.stem, at if has_parts(source, at) else ())]
