"""Pose files opened: the table of structures, and which of them a file has."""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from spt_jax.files.limits import file_errors
from spt_jax.io.poses.bvh import read_bvh
from spt_jax.io.poses.containers import WHAT, Container, open_container
from spt_jax.io.poses.datasets import (
    is_3dpw,
    is_easymocap,
    is_mmhuman3d,
    read_3dpw,
    read_aistpp,
    read_bedlam,
    read_easymocap,
    read_mmhuman3d,
)
from spt_jax.io.poses.folder import read_folder
from spt_jax.io.poses.parts import BODY, ROOT, read_in_parts
from spt_jax.io.poses.people import (
    by_person,
    is_phalp,
    is_romp,
    is_slahmr,
    read_by_person,
    read_gvhmr,
    read_phalp,
    read_romp,
    read_slahmr,
    read_tram,
)
from spt_jax.io.poses.source import Source, UnknownStructureError
from spt_jax.io.poses.track import MotionFile, Track
from spt_jax.io.poses.whole import POSES, is_motion_x, read_bare, read_motion_x, read_whole

SUFFIXES = (".npz", ".npy", ".pkl", ".pickle", ".p", ".joblib", ".pt", ".pth", ".json", ".bvh")
"""The suffixes of pose files; their structure is recognized by their content."""


# Motions that are not read, but are no meshes either: their message is about poses.
_OTHERS = (
    *(".c3d", ".amc", ".asf", ".trc", ".mot", ".mat", ".h5", ".hdf5", ".csv", ".txt", ".dat"),
    *(".ckpt", ".yaml", ".yml", ".parquet"),
)


def is_pose_file(path: str | os.PathLike[str]) -> bool:
    """Whether a file is for the readers of poses, by its suffix; a folder is, too."""
    if os.path.isdir(path):
        return True
    return os.path.splitext(os.fspath(path))[1].lower() in (*SUFFIXES, *_OTHERS, "")


class Structure(NamedTuple):
    """A structure of pose files.

    Attributes:
        name: whose it is.
        matches: whether an opened file has it; the first in the table that matches is taken.
        read: its tracks.
    """

    name: str
    matches: Callable[[Any], bool]
    read: Callable[[Source], list[Track]]


def _has(*keys: str | tuple[str, ...]) -> Callable[[Any], bool]:
    """A dictionary with each of some keys, or with one of several."""

    def matches(tree: Any) -> bool:
        wanted = [(key,) if isinstance(key, str) else key for key in keys]
        return isinstance(tree, Mapping) and all(any(k in tree for k in one) for one in wanted)

    return matches


def _numbers(tree: Any) -> bool:
    return isinstance(tree, np.ndarray) and tree.dtype.kind in "fiu"


STRUCTURES = (
    Structure("BVH", _has("header", "joints", "motion"), read_bvh),
    Structure("Motion-X", is_motion_x, read_motion_x),
    Structure("an array of poses", _numbers, read_bare),
    Structure("EasyMocap", is_easymocap, read_easymocap),
    Structure("PHALP", is_phalp, read_phalp),
    Structure("VIBE, PyMAF or WHAM", by_person, read_by_person),
    Structure("GVHMR", _has("smpl_params_global"), read_gvhmr),
    Structure("TRAM", _has("pred_rotmat"), read_tram),
    Structure("ROMP or BEV", is_romp, read_romp),
    Structure("AIST++", _has("smpl_poses"), read_aistpp),
    Structure("3DPW", is_3dpw, read_3dpw),
    Structure("BEDLAM", _has(("pose_world", "pose_cam")), read_bedlam),
    Structure("MMHuman3D", is_mmhuman3d, read_mmhuman3d),
    Structure("SLAHMR", lambda tree: isinstance(tree, Mapping) and is_slahmr(tree), read_slahmr),
    Structure("AMASS", _has(POSES), read_whole),
    Structure("SMPL's parts", _has(ROOT, BODY), read_in_parts),
    Structure("HMR2", _has("pred_smpl_params"), read_in_parts),
)
"""All that are read. Adding one is a line here and its reader in the module of its family."""

_KNOWN = (
    "AMASS (poses), SMPL's parts (global_orient with body_pose: SMPLify-X, PROX, HMR2, VPoser), "
    "PHALP, VIBE, PyMAF, WHAM, GVHMR, TRAM, ROMP, BEV, SLAHMR, BEDLAM, AIST++, 3DPW, MOYO, "
    "EasyMocap, MMHuman3D, Motion-X and BVH"
)


def load_poses(
    path: str | os.PathLike[str],
    *,
    people: str | int | Sequence[str | int] | None = None,
    max_bytes: int | None = None,
) -> list[Track]:
    """The tracks of a pose file, one a person.

    Structures are distinguished by what is in the file: AMASS and MOYO, SMPLify-X, PROX, HMR2 and
    VPoser's parts, PHALP (4D-Humans), VIBE, PyMAF, WHAM, GVHMR, TRAM, ROMP, BEV, SLAHMR, BEDLAM,
    AIST++, 3DPW, EasyMocap, MMHuman3D, Motion-X and BVH, in .npz, .npy, .pkl (joblib's too), .pt,
    .json and .bvh. Rotations may be axis-angle vectors, matrices, six numbers or quaternions.
    Pickles are read without running anything that they name, and without PyTorch or joblib.

    Args:
        path: the file, or a folder of files that hold a frame each.
        people: whom, by name or by number from 0; all where None.
        max_bytes: what the file and its arrays may take; 1 GiB where None.

    Returns:
        Tracks with `pose` (frames, J, 3), axis-angle in radians in one of SMPL's layouts,
        `translation`, `shape`, `frame_rate`, `gender` and more, each None where the file has none.

    Raises:
        FileNotFoundError: there is no such file.
        OSError: it cannot be read.
        ValueError: none of these structures, a field that is damaged or of another shape, nobody of
            that name, or a pickle that names what is not read; the message names file, field, rule
            and remedy.

    Example:
        >>> import pathlib, tempfile
        >>> import numpy as np
        >>> from spt_jax.io.pose_files import load_poses
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder) / "slahmr.npz"
        ...     parts = {"root_orient": np.zeros((2, 5, 3)), "pose_body": np.zeros((2, 5, 63))}
        ...     np.savez(file, **parts, trans=np.zeros((2, 5, 3)), betas=np.zeros((2, 16)))
        ...     tracks = load_poses(file)
        >>> [(track.name, track.pose.shape, track.frame_rate) for track in tracks]
        [('0', (5, 22, 3), None), ('1', (5, 22, 3), None)]
    """
    return choose(open_poses(path, max_bytes=max_bytes), people)


def open_poses(path: str | os.PathLike[str], *, max_bytes: int | None = None) -> MotionFile:
    """A pose file with what was left out of it, ready to be written again.

    Args, Raises: as `load_poses`.
    """
    if os.path.isdir(path):
        folder = Path(path)
        inner = [
            file
            for file in folder.rglob("[!.]*")
            if file.suffix.lower() in SUFFIXES and file.is_file()
        ]
        return read_folder(folder, [open_poses(f, max_bytes=max_bytes) for f in sorted(inner)])
    return read_motion(open_container(path, max_bytes=max_bytes))


def read_motion(container: Container) -> MotionFile:
    """The same of a file that is open.

    Raises:
        ValueError: as `load_poses`.
    """
    source = Source(container)
    with file_errors(WHAT, container.path):
        structure = next((one for one in STRUCTURES if one.matches(source.tree)), None)
        if structure is None:
            raise UnknownStructureError(_unknown(source))
        tracks = structure.read(source)
        if not tracks:
            raise ValueError(
                f"pose file must hold at least one person: got {source.file!r}, in the "
                f"structure of {structure.name}, with none"
            )
        counts = Counter(track.name for track in tracks)
        twice = [name for name, count in counts.items() if count > 1]
        if twice:
            raise ValueError(
                f"pose file must call each person by another name: got {twice[0]!r} more than "
                f"once in {source.file!r}"
            )
        unused = source.unused()
    single = len(tracks) == 1
    named = tuple(
        track.named(track.name, source.stem if single else f"{source.stem}/{track.name}")
        for track in tracks
    )
    notes = [*source.notes, *([f"not used: {', '.join(unused)}"] if unused else [])]
    return MotionFile(container.path, structure.name, named, tuple(notes), tuple(unused), container)


def choose(file: MotionFile, people: str | int | Iterable[str | int] | None) -> list[Track]:
    """The tracks of some people.

    Raises:
        ValueError: there is nobody of that name or number.
    """
    if people is None:
        return list(file.tracks)
    names = [track.name for track in file.tracks]
    chosen = []
    for wanted in [people] if isinstance(people, str | int) else people:
        name = str(wanted)
        if name in names:
            chosen.append(names.index(name))
        elif name.isdecimal() and int(name) < len(names):
            chosen.append(int(name))
        else:
            raise ValueError(
                f"people must be among {', '.join(map(repr, names[:20]))}, or numbers from 0 to "
                f"{len(names) - 1}: got {name!r} for {str(file.path)!r}"
            )
    return [file.tracks[k] for k in dict.fromkeys(chosen)]


def _unknown(source: Source) -> str:
    tree, what = source.tree, "it holds"
    if isinstance(tree, Mapping):
        keys = ", ".join(repr(str(key)) for key in list(tree)[:12])
        what += f" keys {keys}{', ...' * (len(tree) > 12)}"
    elif isinstance(tree, list):
        first = tree[0] if tree else None
        what += f" a list of {len(tree)}, "
        what += f"keys {list(map(str, first))[:12]}" if isinstance(first, Mapping) else "no people"
    else:
        what += f" {type(tree).__name__}"
    remedy = (
        "write global_orient, body_pose and transl, or AMASS' poses, to an .npz; known are "
        f"{_KNOWN}"
    )
    if any(word in what for word in ("keypoints", "'people'", "'annotations'")):
        remedy = "it looks like keypoints, which `spt-jax fit` reads"
    elif "'v_template'" in what:
        remedy = "it looks like a body model, which --body takes"
    return (
        f"pose file must hold poses in a structure that is known: got {source.file!r}; {what}; "
        f"{remedy}."
    )
