"""Files that the live view reads, whatever they hold, and what it hands out."""

import re
import secrets
import tempfile
import warnings
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from spt_jax._mesh_check import check_mesh
from spt_jax.body import AbstractBody, RigModel, load_body, load_mocap
from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.files.archives import read_npz
from spt_jax.files.limits import as_file, read_bytes
from spt_jax.io.mesh_files import read_mesh, write_mesh
from spt_jax.io.pose_files import MotionFile, Track, is_pose_file, open_poses, write_poses
from spt_jax.io.rigs.arrays import write_rig_poses
from spt_jax.io.rigs.reading import is_rig_file, load_rigs
from spt_jax.view.scene import Reading, Scene

_SUFFIX = re.compile(r"\.[a-z0-9]{1,8}", re.ASCII)
_LONGEST_NAME = 80


@dataclass(frozen=True, eq=False)
class Frames:
    """Poses in a body's own joints, to be looked through."""

    names: list[str]
    pose: Float[np.ndarray, "N J 3"]
    shape: Float[np.ndarray, "N B"] | None = None
    translation: Float[np.ndarray, "N 3"] | None = None
    rate: float = 30.0  # frames a second

    def load_into(self, scene: Scene, row: int) -> None:
        """Show one frame."""
        shape = None if self.shape is None else self.shape[row]
        translation = None if self.translation is None else self.translation[row]
        scene.load(self.pose[row], shape, translation)


class Rigged(NamedTuple):
    """A rigged character: its scene, its animations as motions, and what was left out."""

    scene: Scene
    motions: dict[str, Frames]
    notes: tuple[str, ...]


def open_file(
    path: Path, name: str | None = None, *, max_bytes: int | None = None
) -> Scene | MotionFile | Rigged:
    """What a file holds: a mesh or a body as a scene, a rigged character, or poses.

    Args:
        path: .pkl and .npz are an SMPL model where they have `v_template`, otherwise poses, as are
            the other suffixes of pose files; anything else is a mesh, which must be closed.
        name: what a scene is called; the file's name without its suffix if None.
        max_bytes: what the file and its arrays may take once unpacked; 1 GiB where None.

    Raises:
        FileNotFoundError, OSError: there is no such file, or the system does not let it be read.
        TooLargeError: it takes more than the limit.
        ValueError: no regular file, one that cannot be read, or a mesh that is not closed and
            consistently wound.
    """
    path = as_file(path)  # a pipe would be waited for
    if _is_model(path, max_bytes):
        with warnings.catch_warnings():  # of holes, which the scene's own notes say
            warnings.simplefilter("ignore", UserWarning)
            body = load_body(path, max_bytes=max_bytes)
        return Scene.of_body(body, name or path.stem)
    if is_rig_file(path, max_bytes=max_bytes):
        return _rigged(path, name, max_bytes)
    if is_pose_file(path):
        return open_poses(path, max_bytes=max_bytes)
    vertices, faces = read_mesh(path, max_bytes=max_bytes)
    check_mesh(vertices, faces).raise_if_unfit()
    return Scene.of_mesh(vertices, faces, name or path.stem)


def _rigged(path: Path, name: str | None, max_bytes: int | None) -> Rigged:
    """The first character of a rig file; what others there are is said."""
    rigs = load_rigs(path, dtype=np.float32, max_bytes=max_bytes)
    rig, notes = rigs[0], [*rigs[0].notes]
    if len(rigs) > 1:
        notes.append(f"Of {len(rigs)} characters the first is shown, {rig.name}.")
    motions = {}
    for clip in (rig.clip(), *map(rig.clip, rig.animations)):
        names = [clip.name] if clip.frame_rate is None else []
        names = names or [f"{clip.name}/{row:04d}" for row in range(len(clip.times))]
        arrays = (x.astype(np.float32) for x in (clip.pose, clip.shape, clip.translation))
        motions[clip.name] = Frames(names, *arrays, rate=clip.frame_rate or 30.0)
    return Rigged(Scene.of_body(rig.body, name or path.stem), motions, tuple(notes))


def open_upload(
    name: str, content: bytes, *, max_bytes: int | None = None
) -> Scene | MotionFile | Rigged:
    """The same for a file that a browser sent; nothing of it stays on the disk.

    On the disk it has a name of our own: of the one that it came with, the suffix says which reader
    takes it, and the rest is shown, never looked up.

    Raises:
        ValueError: as `open_file`; the message says the file's name, not where it lay meanwhile.
    """
    label = label_of(name)
    title, suffix = PurePosixPath(label).stem, PurePosixPath(label).suffix.lower()
    own = secrets.token_hex(8)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / (own + (suffix if _SUFFIX.fullmatch(suffix) else ""))
        path.write_bytes(content)
        try:
            opened = open_file(path, title, max_bytes=max_bytes)
        except (OSError, TypeError, ValueError) as error:
            message = str(error).replace(str(path), label).replace(path.name, label)
            raise ValueError(message.replace(own, title)) from error
    if isinstance(opened, MotionFile):  # frames without names are called after their file
        tracks = tuple(
            replace(
                track,
                name=track.name.replace(own, title),
                names=[frame.replace(own, title) for frame in track.names],
            )
            for track in opened.tracks
        )
        opened = replace(opened, tracks=tracks)
    return opened


def label_of(name: str) -> str:
    """A file's name as it can be shown: one printable line, without folders.

    Example:
        >>> from spt_jax.view.files import label_of
        >>> label_of("..\\\\folder/walk.npz"), label_of("a\\nb.ply"), label_of("/")
        ('walk.npz', 'a b.ply', 'file')
    """
    last = name.replace("\\", "/").rstrip("/").rpartition("/")[2]
    label = "".join(letter if letter.isprintable() else " " for letter in last).strip()
    return label[-_LONGEST_NAME:] if label.strip(".") else "file"


def frames_for(given: Track, body: AbstractBody, *, embedded: bool) -> tuple[Frames, list[str]]:
    """A track's poses on a body, and what of them had to be left out."""
    notes = []
    shape = given.shape
    if shape is not None and embedded:
        notes.append("The file's shape is left out: it is in SMPL's components.")
        shape = None
    elif shape is not None and shape.shape[-1] > body.num_shape:
        notes.append(f"Shape components after the body's {body.num_shape} are left out.")
        shape = shape[..., : body.num_shape]
    if given.expression is not None and given.expression.any():
        notes.append("The file's expressions are left out: the view has none.")
    if shape is not None:
        shape = np.broadcast_to(shape, (len(given.pose), shape.shape[-1]))
    layout = SMPL_LAYOUTS[given.pose.shape[1]]
    turned = np.any(given.pose, axis=(0, 2))
    lost = [name for name, used in zip(layout, turned, strict=True) if used]
    lost = [name for name in lost if name not in body.joint_names]
    if lost:
        shown = ", ".join(lost[:4]) + (", ..." if len(lost) > 4 else "")
        notes.append(f"The body lacks {shown}: their rotations are left out.")
    pose = np.asarray(body.pose_from_smpl(given.pose.astype(np.float32)))
    rate = given.frame_rate or 30.0
    return Frames(list(given.names), pose, shape, given.translation, rate), notes


def motions_of(
    given: MotionFile, name: str, body: AbstractBody, *, embedded: bool
) -> tuple[dict[str, Frames], list[str]]:
    """The people of a file on a body, each a motion, and what had to be left out, once each."""
    motions, notes = {}, list(given.notes)
    for track in given.tracks:
        label = name if len(given.tracks) == 1 else f"{name}: {track.name}"
        motions[label], more = frames_for(track, body, embedded=embedded)
        notes += more
    return motions, list(dict.fromkeys(notes))


def mocap_for(body: AbstractBody) -> dict[str, Frames]:
    """The motions that come with the package, on a body."""
    mocap = load_mocap()
    poses = np.asarray(body.pose_from_smpl(mocap.pose))
    motions = np.array([name.split("/")[0] for name in mocap.names])
    return {
        motion: Frames(
            [name for name in mocap.names if name.split("/")[0] == motion],
            poses[motions == motion],
        )
        for motion in dict.fromkeys(motions.tolist())
    }


def mesh_bytes(scene: Scene, reading: Reading) -> bytes:
    """The surface as a .glb, colored by label."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.glb"
        write_mesh(path, reading.vertices, scene.faces, reading.labels)
        return path.read_bytes()


def pose_bytes(scene: Scene) -> bytes:
    """The pose as an .npz in AMASS' layout, with shape and translation; of a rig with names.

    Raises:
        ValueError: a mesh has no pose.
    """
    if scene.body is None:
        raise ValueError("pose must come from a body: got a mesh; save it as .glb.")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pose.npz"
        if isinstance(scene.body, RigModel):
            rows = (scene.pose[None], scene.shape[None], scene.translation[None])
            write_rig_poses(path, scene.body, *rows, None)
            return path.read_bytes()
        write_poses(path, scene.pose, shape=scene.shape, translation=scene.translation)
        return path.read_bytes()


def _is_model(path: Path, max_bytes: int | None) -> bool:
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return "v_template" in read_npz(path, _nothing).names
    return suffix == ".pkl" and b"v_template" in read_bytes(path, max_bytes=max_bytes)


def _nothing(array: str) -> bool:
    return False
