"""What data sets and toolboxes write: AIST++, 3DPW, BEDLAM, EasyMocap, MMHuman3D."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from spt_jax.io.poses.parts import SHAPE, has_parts, parts_track, track_of
from spt_jax.io.poses.rotations import AXIS_ANGLE
from spt_jax.io.poses.source import MOST_METRES, MOST_SHAPE, Block, Source, Way, spelt
from spt_jax.io.poses.track import Track
from spt_jax.io.poses.whole import whole_pose

_BODY = tuple(range(1, 22))


def read_aistpp(source: Source) -> list[Track]:
    """AIST++: `smpl_poses` (N, 72), `smpl_trans` and the scale of both body and positions.

    google/aistplusplus_api, aist_plusplus/loader.py; positions in metres are
    `smpl_trans / smpl_scaling` (demos/extract_motion_feats.py).
    """
    pose, block = whole_pose(source, ("smpl_poses",))
    shift = source.translation(source.first((), ("smpl_trans",)), len(pose))
    scale = source.first((), ("smpl_scaling",))
    if shift is not None and scale is not None:
        values = source.numbers(scale, most=MOST_METRES)
        if values.size != 1 or not values.item() > 0:
            raise ValueError(
                f"smpl_scaling must be one positive number: got {np.array2string(values)} in "
                f"{source.file!r}"
            )
        shift = shift / values.item()
        source.note("positions are divided by smpl_scaling, which makes them metres")
    return [Track(source.stem, pose, shift, blocks=(block,))]


def is_3dpw(tree: Any) -> bool:
    """Lists of people, each with whole poses."""
    poses: Any = tree.get("poses") if isinstance(tree, Mapping) else None
    listed = isinstance(poses, list) or (isinstance(poses, np.ndarray) and poses.dtype.hasobject)
    return listed and "trans" in tree and len(poses) > 0 and np.ndim(poses[0]) == 2


def read_3dpw(source: Source) -> list[Track]:
    """3DPW: lists with an entry for each person, `poses` (N, 72) at the images' rate.

    The readme of 3DPW's sequenceFiles: `trans`, `betas`, `genders`; `poses_60Hz` are the same
    motion at another rate.
    """
    tracks = []
    for k in range(len(source.tree["poses"])):
        pose, block = whole_pose(source, ("poses", k))
        way = source.first((), ("betas",))
        shape = None
        if way is not None:
            # Some have three hundred coefficients of which ten are used.
            shape = source.numbers((*way, k), most=MOST_SHAPE).reshape(-1)
        shift = source.translation(("trans", k), len(pose))
        gender = source.gender(source.first((), ("genders", "gender")), k)
        tracks.append(Track(str(k), pose, shift, shape, gender=gender, blocks=(block,)))
    return tracks


def read_bedlam(source: Source) -> list[Track]:
    """BEDLAM and AGORA's labels: a row for each person in each image, `pose_world` or `pose_cam`.

    pixelite1201/BEDLAM, data_processing/ReadMe.md and df_full_body.py: `shape`, `trans_world`,
    `gender`, `imgname` and `sub`, the person. Rows of one person in one folder of images are a
    track.
    """
    world = source.first((), ("pose_world",))
    main = world or ("pose_cam",)
    pose, block = whole_pose(source, main)
    other = None
    if world is not None and source.get(("pose_cam",)) is not None:
        other = whole_pose(source, ("pose_cam",))[1]
        source.used |= {("trans_cam",), ("cam_ext",)}
    elif world is None:
        source.note("positions are trans_cam, to which BEDLAM adds those of cam_ext")
    shift_way = ("trans_world",) if world is not None else ("trans_cam",)
    shift = source.translation(source.first((), (shift_way[0],)), len(pose))
    shape = source.shape(source.first((), SHAPE), len(pose))
    people, images = (_labels(source, key, len(pose)) for key in ("sub", "imgname"))
    keys = [
        (str(PurePosixPath(image).parent) if image else "", person)
        for person, image in zip(people, images, strict=True)
    ]
    folders = {folder for folder, _ in keys}
    tracks = []
    for folder, person in dict.fromkeys(keys):
        rows = np.flatnonzero([key == (folder, person) for key in keys])
        name = "/".join(part for part in (folder if len(folders) > 1 else "", person) if part)
        tracks.append(
            Track(
                name or source.stem,
                pose[rows],
                None if shift is None else shift[rows],
                shape[rows] if shape is not None and shape.ndim == 2 else shape,
                gender=source.gender(source.first((), ("gender",)), int(rows[0])),
                blocks=(block._replace(index=(rows,)),),
                copies=() if other is None else ((other._replace(index=(rows,)),),),
            )
        )
    return tracks


def _labels(source: Source, key: str, rows: int) -> list[str]:
    value = source.get((key,))
    if value is None:
        return [""] * rows
    source.used.add((key,))
    labels = np.ravel(np.asarray(value))
    if len(labels) != rows:
        raise ValueError(
            f"{key} must have one entry a row, {rows}: got {len(labels)} in {source.file!r}"
        )
    return [str(label) for label in labels]


def is_easymocap(tree: Any) -> bool:
    """A list of people, each with `Rh`, `Th` and `poses`."""
    people = tree.get("annots") if isinstance(tree, Mapping) else tree
    return (
        isinstance(people, list)
        and bool(people)
        and all(isinstance(one, Mapping) and "Rh" in one and "poses" in one for one in people)
    )


# How many numbers `poses` has: where the body begins in them, how many components each hand has,
# and how many numbers of jaw and eyes follow (doc/02_output.md; easymocap/smplmodel/body_model.py,
# `extend_pose`).
_EASYMOCAP = {
    72: (3, 0, 0),
    69: (0, 0, 0),
    66: (3, 0, 0),
    63: (0, 0, 0),
    78: (3, 6, 0),
    75: (0, 6, 0),
    87: (3, 6, 9),
    84: (0, 6, 9),
}


def read_easymocap(source: Source) -> list[Track]:
    """EasyMocap: people of one frame, or of several, each with `Rh`, `Th`, `poses` and `shapes`.

    zju3dv/EasyMocap, easymocap/mytools/file_utils.py (`write_smpl`) and doc/02_output.md: the
    global orientation is `Rh`, which turns about the origin and not about the pelvis, and the
    first three numbers of `poses` are zero; hands are six components each.
    """
    at: Way = ("annots",) if isinstance(source.tree, Mapping) else ()
    source.note("positions are Th: EasyMocap turns people about the origin, not the pelvis")
    people = source.get(at)
    tracks = [_easymocap_track(source, (*at, k)) for k in range(len(people))]
    names = [track.name for track in tracks]
    return [
        replace(t, name=n if names.count(n) == 1 else f"{n}-{k}")
        for k, (t, n) in enumerate(zip(tracks, names, strict=True))
    ]


def _easymocap_track(source: Source, at: Way) -> Track:
    way = (*at, "poses")
    values = np.atleast_2d(source.numbers(way))
    if values.ndim != 2 or values.shape[1] not in (*_EASYMOCAP, 156, 165):
        raise ValueError(
            f"{spelt(way)} must hold frames of {', '.join(map(str, sorted(_EASYMOCAP)))}, 156 or "
            f"165 numbers: got shape {values.shape} in {source.file!r}"
        )
    width = values.shape[1]
    start, hand, face = _EASYMOCAP.get(width, (3, 0, 0))
    if start and values[:, :3].any():
        raise ValueError(
            f"{spelt(way)} must begin with three zeros beside Rh: got others in "
            f"{source.file!r}; it is of another program"
        )
    root = source.rotations((*at, "Rh"), (0,), frames=len(values), forms=(AXIS_ANGLE,))
    if root is None or len(root[0]) != len(values):
        raise ValueError(
            f"{spelt((*at, 'Rh'))} must hold {len(values)} axis-angle vectors: got shape "
            f"{source.numbers((*at, 'Rh')).shape} in {source.file!r}"
        )
    count = 55 if face else 24 if width - start == 69 else 22
    if width in (156, 165):  # whole poses of SMPL-H and SMPL-X
        count = width // 3
    body = _BODY if count == 22 or face else tuple(range(1, count))
    ends = start + 3 * len(body)
    columns = [(slice(start, ends), body)]
    if face:
        columns.append((slice(ends + 2 * hand, ends + 2 * hand + face), (22, 23, 24)))
    pose, blocks = np.zeros((len(values), count, 3)), [root[1]]
    pose[:, 0] = root[0][:, 0]
    flat = np.ndim(source.get(way)) == 1
    for column, joints in columns:
        pose[:, joints] = values[:, column].reshape(len(values), -1, 3)
        blocks.append(Block(way, (column,) if flat else (slice(None), column), AXIS_ANGLE, joints))
    given: dict[str, Any] = {}
    if hand:
        given = {
            "left_hand": values[:, ends : ends + hand],
            "right_hand": values[:, ends + hand : ends + 2 * hand],
        }
        source.note(
            f"poses has {hand} components of each of MANO's hands, which a body that has hand "
            "components turns into rotations"
        )
    person = source.get((*at, "id"))
    source.used.add((*at, "id"))
    name = str(person) if isinstance(person, int | str) else str(at[-1])
    return track_of(source, name, pose, tuple(blocks), at, **given)


def is_mmhuman3d(tree: Any) -> bool:
    """HumanData: parameters of a body in a dictionary of its own."""
    return isinstance(tree, Mapping) and any(
        isinstance(tree.get(k), Mapping) for k in ("smplx", "smpl")
    )


def read_mmhuman3d(source: Source) -> list[Track]:
    """MMHuman3D's HumanData: `smplx` or `smpl`, a dictionary of parts, and `meta` with a gender.

    open-mmlab/mmhuman3d, docs/human_data.md and mmhuman3d/data/data_structures/human_data.py. Its
    entries are the rows of a data set: they are taken for frames of one person.
    """
    at = next((key,) for key in ("smplx", "smpl") if isinstance(source.tree.get(key), Mapping))
    if at == ("smplx",) and isinstance(source.tree.get("smpl"), Mapping):
        source.note("smpl is left out: the file has smplx beside it")
        source.used.add(("smpl",))
    meta = source.first(("meta",), ("gender",))
    gender = source.gender(meta if meta and np.ndim(source.get(meta)) == 0 else None)
    if not has_parts(source, at):
        raise ValueError(
            f"{at[0]} must hold global_orient and body_pose: got {sorted(source.get(at))} in "
            f"{source.file!r}"
        )
    return [parts_track(source, source.stem, at, gender=gender)]
