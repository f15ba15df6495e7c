"""What regressors write of people in videos: VIBE, PyMAF, WHAM, PHALP, TRAM, GVHMR, and more."""

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from spt_jax.io.poses.parts import read_parts, track_of
from spt_jax.io.poses.rotations import AXIS_ANGLE, MATRIX, SIX_COLUMNS
from spt_jax.io.poses.source import MOST_METRES, MOST_SHAPE, Block, Source, Way
from spt_jax.io.poses.track import Track
from spt_jax.io.poses.whole import whole_pose

_SMPL = tuple(range(24))


def by_person(tree: Any) -> bool:
    """A dictionary of people, each with a whole `pose`."""
    return (
        isinstance(tree, Mapping)
        and len(tree) > 0
        and all(isinstance(one, Mapping) and "pose" in one for one in tree.values())
    )


def read_by_person(source: Source) -> list[Track]:
    """VIBE, PyMAF and WHAM: people by number, each with `pose` (N, 72), `betas` and `frame_ids`.

    mkocabas/VIBE, demo.py; HongwenZhang/PyMAF, demo.py; yohanshin/WHAM, demo.py. WHAM has the
    motion in the world, `pose_world` and `trans_world`, beside that in the camera; it is taken.
    """
    tracks = []
    for person in source.tree:
        at = (person,)
        world = source.first(at, ("pose_world",))
        pose, block = whole_pose(source, world or (*at, "pose"))
        copies, given = (), {}
        if world is not None:
            copy, other = whole_pose(source, (*at, "pose"))
            copies = ((other,),) if copy.shape == pose.shape else ()
            source.used.add((*at, "trans"))
            way = source.first(at, ("trans_world",))
            given["translation"] = source.translation(way, len(pose))
        given["frames"] = _frame_numbers(source, (*at, "frame_ids"), len(pose))
        tracks.append(track_of(source, str(person), pose, (block,), at, copies=copies, **given))
    return tracks


def _frame_numbers(source: Source, way: Way, frames: int) -> np.ndarray | None:
    if source.get(way) is None:
        return None
    numbers = source.numbers(way, most=1e9).reshape(-1)
    if len(numbers) != frames:
        return None
    return numbers.astype(np.int64)


def is_phalp(tree: Any) -> bool:
    """A dictionary of frames, each with lists of people."""
    return (
        isinstance(tree, Mapping)
        and bool(tree)
        and all(
            isinstance(frame, Mapping) and "smpl" in frame and "tid" in frame
            for frame in tree.values()
        )
    )


def read_phalp(source: Source) -> list[Track]:
    """PHALP and 4D-Humans: frames by name, each with lists of `tid`, `smpl` and `camera`.

    `smpl` is a dictionary of matrices and betas (brjathu/PHALP, phalp/trackers/PHALP.py and
    phalp/utils/utils_tracks.py). Where `tracked_time` is not 0 the frame was predicted, not seen.
    """
    found: dict[Hashable, list[tuple[Any, int]]] = {}
    predicted = 0
    for name, frame in source.tree.items():
        source.used |= {(name, key) for key in ("tid", "tracked_time", "time")}
        for k, person in enumerate(frame["tid"]):
            found.setdefault(_plain(person), []).append((name, k))
            times = frame.get("tracked_time") or []
            predicted += bool(k < len(times) and times[k])
    if predicted:
        source.note(f"{predicted} of the frames were predicted by the tracker, not seen")
    return [_phalp_track(source, str(person), places) for person, places in _in_order(found)]


def _phalp_track(source: Source, person: str, places: Sequence[tuple[Any, int]]) -> Track:
    poses, blocks, shapes, shifts, numbers = [], [], [], [], []
    order = {name: k for k, name in enumerate(source.tree)}
    for row, (name, k) in enumerate(places):
        at = (name, "smpl", k)
        if not isinstance(source.get(at), Mapping):
            raise ValueError(
                f"smpl must hold a dictionary for each tid: got {len(source.get((name, 'smpl')))} "
                f"for {k + 1} or more in frame {name!r} of {source.file!r}"
            )
        parts = read_parts(source, at)
        poses.append(parts.pose[0])
        blocks += [block._replace(rows=slice(row, row + 1)) for block in parts.blocks]
        if source.get((*at, "betas")) is not None:
            shapes.append(source.numbers((*at, "betas"), most=MOST_SHAPE).reshape(-1))
        if source.get((name, "camera", k)) is not None:
            shifts.append(source.numbers((name, "camera", k), most=MOST_METRES).reshape(-1)[:3])
        time = source.tree[name].get("time", order[name])
        numbers.append(int(time) if isinstance(time, int | np.integer) else order[name])
    return Track(
        person,
        np.stack(poses),
        translation=_stacked(shifts, len(poses), 3),
        shape=_stacked(shapes, len(poses), None),
        frames=np.array(numbers),
        blocks=tuple(blocks),
    )


def _stacked(rows: list[np.ndarray], frames: int, width: int | None) -> np.ndarray | None:
    widths = {len(row) for row in rows}
    if len(rows) != frames or len(widths) != 1 or (width is not None and widths != {width}):
        return None
    return np.stack(rows)


def read_tram(source: Source) -> list[Track]:
    """TRAM: one person a file, matrices `pred_rotmat` (N, 24, 3, 3), `pred_trans`, `pred_shape`.

    yufu-wang/tram, lib/models/hmr_vimo.py (`inference`) and scripts/estimate_humans.py. The same
    rotations stand there as six numbers, `pred_pose`.
    """
    found = source.rotations(("pred_rotmat",), _SMPL, forms=(MATRIX,))
    if found is None:
        raise ValueError(
            f"pred_rotmat must hold frames of 24 matrices (N, 24, 3, 3): got shape "
            f"{source.numbers(('pred_rotmat',)).shape} in {source.file!r}"
        )
    pose, block = found
    copies = ()
    six = source.first((), ("pred_pose",))
    if six is not None and source.numbers(six).size == 6 * 24 * len(pose):
        copies = ((Block(six, (), SIX_COLUMNS, _SMPL),),)
    shift = source.translation(source.first((), ("pred_trans",)), len(pose))
    shape = source.shape(source.first((), ("pred_shape",)), len(pose))
    frames = _frame_numbers(source, ("frame",), len(pose))
    return [Track(source.stem, pose, shift, shape, frames=frames, blocks=(block,), copies=copies)]


def read_gvhmr(source: Source) -> list[Track]:
    """GVHMR: one person, `smpl_params_global`, and the same in the camera, `smpl_params_incam`.

    Parts of SMPL-X without hands (zju3dv/GVHMR, hmr4d/model/gvhmr/gvhmr_pl_demo.py).
    """
    at = ("smpl_params_global",)
    parts = read_parts(source, at)
    copies = ()
    if isinstance(source.get(("smpl_params_incam",)), Mapping):
        copies = (read_parts(source, ("smpl_params_incam",)).blocks,)
        source.used |= {("smpl_params_incam", key) for key in ("transl", "betas")}
    return [track_of(source, source.stem, parts.pose, parts.blocks, at, copies=copies)]


def is_romp(tree: Any) -> bool:
    """Results of ROMP or BEV, of one image or of a video."""
    results = tree.get("results") if isinstance(tree, Mapping) else None
    if not isinstance(results, Mapping):
        return False
    frames = [results] if "smpl_thetas" in results else list(results.values())
    return any(isinstance(frame, Mapping) and "smpl_thetas" in frame for frame in frames)


def read_romp(source: Source) -> list[Track]:
    """ROMP and BEV: `results` of an image, or by image of a video; people by row or `track_ids`.

    `smpl_thetas` (n, 72), `smpl_betas` (n, 10; BEV's eleventh is the weight of its child) and
    `cam_trans` (Arthur151/ROMP, simple_romp/romp/utils.py, `ResultSaver` and
    `save_video_results`, and simple_romp/bev/main.py).
    """
    results = source.tree["results"]
    single = "smpl_thetas" in results
    images = [((), results)] if single else [((name,), one) for name, one in results.items()]
    found: dict[Hashable, list[tuple[Way, int, int]]] = {}
    copies = _romp_sequences(source)
    for number, (name, image) in enumerate(images):
        if not isinstance(image, Mapping) or "smpl_thetas" not in image:
            continue
        at = ("results", *name)
        count = len(np.atleast_2d(source.numbers((*at, "smpl_thetas"))))
        ids = image.get("track_ids")
        if ids is None and not single and count > 1:
            source.note("the file tracks nobody: people are numbered by their row in each image")
        people = range(count) if ids is None else [_plain(one) for one in np.ravel(ids)][:count]
        source.used.add((*at, "track_ids"))
        for row, person in enumerate(people):
            found.setdefault(person, []).append((at, row, number))
    return [
        _romp_track(source, person, places, copies.get(person, {}), single)
        for person, places in _in_order(found)
    ]


def _romp_track(
    source: Source,
    person: Hashable,
    places: Sequence[tuple[Way, int, int]],
    copies: Mapping[int, Block],
    single: bool,
) -> Track:
    poses, blocks, shapes, shifts, again = [], [], [], [], []
    for frame, (at, row, number) in enumerate(places):
        flat = np.ndim(source.get((*at, "smpl_thetas"))) == 1
        index = () if flat else (row,)
        found = source.rotations((*at, "smpl_thetas"), _SMPL, index=index, forms=(AXIS_ANGLE,))
        if found is None:
            raise ValueError(
                f"smpl_thetas must hold 72 numbers a person: got shape "
                f"{source.numbers((*at, 'smpl_thetas')).shape} in {source.file!r}"
            )
        rows = slice(frame, frame + 1)
        poses.append(found[0][0])
        blocks.append(found[1]._replace(rows=rows))
        if number in copies:
            again.append(copies[number]._replace(rows=rows))
        for key, kept, most in (
            ("smpl_betas", shapes, MOST_SHAPE),
            ("cam_trans", shifts, MOST_METRES),
        ):
            if source.get((*at, key)) is not None:
                kept.append(source.numbers((*at, key), index, most).reshape(-1))
    shape = _stacked(shapes, len(poses), None)
    if shape is not None and shape.shape[1] == 11:
        source.note("BEV's eleventh shape coefficient, of its child, is left out")
        shape = shape[:, :10]
    return Track(
        str(person),
        np.stack(poses),
        _stacked(shifts, len(poses), 3),
        shape,
        frames=None if single else np.array([number for _, _, number in places]),
        blocks=tuple(blocks),
        copies=(tuple(again),) if len(again) == len(poses) else (),
    )


def _romp_sequences(source: Source) -> dict[Hashable, dict[int, Block]]:
    """Where a video's poses stand once more, by track and frame."""
    sequences = source.get(("sequence_results",))
    found: dict[Hashable, dict[int, Block]] = {}
    for person, one in sequences.items() if isinstance(sequences, Mapping) else ():
        thetas, numbers = one.get("smpl_thetas"), one.get("frame_id")
        if not isinstance(thetas, list) or not isinstance(numbers, list):
            continue
        source.used |= {("sequence_results", person, key) for key in one}
        found[_plain(person)] = {
            int(number): Block(
                ("sequence_results", person, "smpl_thetas", k), (), AXIS_ANGLE, _SMPL
            )
            for k, number in enumerate(numbers[: len(thetas)])
        }
    return found


def _in_order(found: dict[Hashable, Any]) -> list[tuple[Hashable, Any]]:
    """People by their numbers, where all have one."""
    numbers = {key: value for key, value in found.items() if isinstance(key, int)}
    return sorted(numbers.items()) if len(numbers) == len(found) else list(found.items())


def _plain(value: Any) -> Hashable:
    """A person's number, whatever holds it."""
    return value.item() if isinstance(value, np.generic | np.ndarray) else value


def is_slahmr(tree: Any) -> bool:
    """Parts of several people at once, a person in each row."""
    body: Any = tree.get("pose_body") if isinstance(tree, Mapping) else None
    return "root_orient" in tree and np.ndim(body) == 3 and np.shape(body)[2] == 63


def read_slahmr(source: Source) -> list[Track]:
    """SLAHMR: `root_orient` (B, T, 3), `pose_body` (B, T, 63), `trans`, `betas` (B, 16).

    vye16/slahmr, slahmr/optim/output.py and slahmr/optim/base_scene.py (`get_optim_result`).
    """
    people = len(source.get(("pose_body",)))
    tracks = []
    for k in range(people):
        parts = read_parts(source, (), (k,))
        shift, shape = (source.first((), names) for names in (("trans",), ("betas",)))
        frames = len(parts.pose)
        one = np.ndim(source.get(("betas",))) == 1
        tracks.append(
            Track(
                str(k),
                parts.pose,
                source.translation(shift, frames, (k,)),
                source.shape(shape, frames, () if one else (k,)),
                blocks=parts.blocks,
            )
        )
    return tracks
