"""Rig files opened: characters as bodies, their animations as poses, and the way back."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import DTypeLike

from spt_jax.body.rig import RigModel
from spt_jax.files.limits import TooLargeError, as_file, file_errors
from spt_jax.files.outputs import atomic_write
from spt_jax.io.meshes.raw import UnreadableError
from spt_jax.io.rigs.animations import Animation, read_animations
from spt_jax.io.rigs.building import Built, build
from spt_jax.io.rigs.characters import find_characters, read_skins
from spt_jax.io.rigs.clips import Clip, sample
from spt_jax.io.rigs.document import SUFFIXES, WHAT, Document, open_document
from spt_jax.io.rigs.nodes import read_nodes
from spt_jax.io.rigs.primitives import default_weights
from spt_jax.io.rigs.rewriting import with_animation


@dataclass(frozen=True, eq=False)
class RigFile:
    """One character of a rig file: its body, its animations, and the way back into the file.

    Attributes:
        path: the file.
        name: of the character.
        body: the character.
        animations: names of its animations, in the file's order.
        notes: what was done or left out to read it, one sentence each.
        rows: of each vertex of the character's primitives, one after the other in the order of
            their nodes, that of `body`: vertices along seams are joined, and those that no triangle
            has are left out, -1.
    """

    path: Path
    name: str
    body: RigModel
    animations: tuple[str, ...]
    notes: tuple[str, ...]
    rows: Any
    _document: Document
    _built: Built
    _animations: tuple[Animation, ...]
    _weights: dict[int, np.ndarray]

    def clip(
        self, animation: str | int | None = None, *, frames_per_second: float | None = None
    ) -> Clip:
        """The poses of an animation.

        Args:
            animation: its name, or its number from 0; None for the pose without one.
            frames_per_second: how often it is sampled. None: as often as its keys follow each other
                where they do so evenly and at least 20 times a second, otherwise 30 times.

        Raises:
            ValueError: no such animation; a rate that is not positive and finite.
        """
        if frames_per_second is not None and not 0 < frames_per_second < np.inf:
            raise ValueError(f"frames_per_second must be positive: got {frames_per_second!r}.")
        found = None if animation is None else self._animation(animation)
        return sample(self._built, self._weights, found, frames_per_second)

    def write(self, path: str | os.PathLike[str], clips: Clip | Sequence[Clip]) -> tuple[str, ...]:
        """Write the file once more as one .glb, with motions of this character as animations.

        All that the file has stays, byte for byte, skins, materials and animations included. Of an
        animation that a clip was sampled from, the new one has all channels, but the rotations of
        those joints that turn otherwise.

        Args:
            path: the file to write; .glb, or .vrm where it was one.
            clips: what `clip` returned, with other poses. Each becomes an animation called
                "NAME untangled".

        Returns:
            Names of the new animations.

        Raises:
            ValueError: another suffix; a joint that turns has a matrix that shears, which no
                animation may turn.
            OSError: as in `atomic_write`.
        """
        target, given = Path(path), [clips] if isinstance(clips, Clip) else list(clips)
        if target.suffix.lower() not in (".glb", ".vrm"):
            raise ValueError(f"path must end in .glb or .vrm: got {target.name!r}.")
        names = []
        document = self._document
        for clip in given:
            source = next((one for one in self._animations if one.name == clip.name), None)
            before = sample(self._built, self._weights, source, clip.frame_rate)
            names.append(f"{clip.name} untangled")
            document = with_animation(document, self._built, clip, before, source, names[-1])
        with atomic_write(target) as temporary:
            temporary.write_bytes(document.as_glb())
        return tuple(names)

    def _animation(self, wanted: str | int) -> Animation:
        if isinstance(wanted, str):
            found = next((one for one in self._animations if one.name == wanted), None)
            if found is not None:
                return found
        elif 0 <= wanted < len(self._animations):
            return self._animations[wanted]
        raise ValueError(
            f"animation must be one of {', '.join(map(repr, self.animations)) or 'none'}, or a "
            f"number from 0: got {wanted!r} for {str(self.path)!r}."
        )


def load_rigs(
    path: str | os.PathLike[str],
    *,
    scale: float | None = None,
    dtype: DTypeLike | None = None,
    max_bytes: int | None = None,
) -> list[RigFile]:
    """The rigged characters of a .glb, .gltf or .vrm file.

    A character is all that one skeleton moves: meshes whose skins share joints or hang on each
    other's, and meshes without a skin that hang on a joint. Its primitives become one surface,
    closed again where the seams of a texture opened it; any number of weights a vertex; morph
    targets are shape coefficients; nodes may have scales, and matrices. Joints that an animation
    shifts or scales against their parents have coefficients of their own, so that every frame of
    every animation is posed as the specification has it.

    Args:
        path: the file. Its buffers are in it, or in files beside it.
        scale: what lengths are multiplied by. None: 1, unless the character is more than 10 m or
            less than 10 cm long; then a power of ten, and `notes` say so.
        dtype: of the arrays; None means JAX's default.
        max_bytes: what the file and its arrays may take; 1 GiB where None.

    Raises:
        FileNotFoundError, OSError: as `load_body`.
        ValueError: another suffix; no skin; a damaged file: the message names the field.

    Example:
        >>> import pathlib, tempfile
        >>> from spt_jax import load_body
        >>> from spt_jax.io import load_rigs, write_rig
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder) / "body.glb"
        ...     write_rig(file, load_body())
        ...     (rig,) = load_rigs(file)
        >>> rig.body.num_joints, rig.animations
        (52, ())
    """
    file = as_file(path, WHAT)
    if file.suffix.lower() not in SUFFIXES:
        raise ValueError(
            f"{WHAT} must have one of the suffixes {' '.join(SUFFIXES)}: got {file.name!r}; export "
            "it as .glb, which Blender, Maya and Unity do."
        )
    if scale is not None and not 0 < scale < np.inf:
        raise ValueError(f"scale must be positive and finite: got {scale!r}.")
    kind = np.dtype(jnp.zeros(()).dtype if dtype is None else dtype)
    with file_errors(WHAT, file):
        try:
            return _read(file, scale, kind, max_bytes)
        except (TooLargeError, MemoryError, RecursionError, OSError):
            raise
        except UnreadableError as error:
            raise ValueError(
                f"{WHAT} must be a readable glTF: got {str(path)!r}; {error}."
            ) from error
        except (AttributeError, KeyError, TypeError, IndexError) as error:
            raise ValueError(
                f"{WHAT} must be a readable glTF: got {str(path)!r}, whose JSON is not as glTF's "
                f"({type(error).__name__}: {error}); export it again."
            ) from error


def load_rig(
    path: str | os.PathLike[str],
    character: str | int | None = None,
    *,
    scale: float | None = None,
    dtype: DTypeLike | None = None,
    max_bytes: int | None = None,
) -> RigFile:
    """The rigged character of a .glb, .gltf or .vrm file; of several the one that is asked for.

    Args:
        path, scale, dtype, max_bytes: as `load_rigs`.
        character: its name or its number from 0; may be None where there is one.

    Raises:
        As `load_rigs`; ValueError: several characters and none chosen, or none of that name.

    Example:
        >>> import pathlib, tempfile
        >>> import numpy as np
        >>> from spt_jax import load_body, load_mocap, untangle_pose
        >>> from spt_jax.io import load_rig, write_rig
        >>> body, mocap = load_body(num_shape=0), load_mocap()
        >>> pose = body.pose_from_smpl(mocap.pose[mocap.names.index("cartwheel/0103")])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder) / "cartwheel.glb"
        ...     write_rig(file, body, pose[None], name="cartwheel")
        ...     rig = load_rig(file)
        ...     clip = rig.clip("cartwheel")
        ...     found = untangle_pose(rig.body, clip.pose.astype("float32"))
        ...     rig.write(file.with_name("freed.glb"), clip.with_pose(found.pose))
        ('cartwheel untangled',)
        >>> found.is_free.tolist()
        [True]
    """
    rigs = load_rigs(path, scale=scale, dtype=dtype, max_bytes=max_bytes)
    names = [rig.name for rig in rigs]
    if character is None and len(rigs) == 1:
        return rigs[0]
    if isinstance(character, str) and character in names:
        return rigs[names.index(character)]
    if isinstance(character, int) and 0 <= character < len(rigs):
        return rigs[character]
    raise ValueError(
        f"character must be one of {', '.join(map(repr, names))}, or a number from 0: got "
        f"{character!r} for {os.fspath(path)!r}."
    )


def is_rig_file(path: str | os.PathLike[str], *, max_bytes: int | None = None) -> bool:
    """Whether a glTF file has skins on meshes; nothing but its JSON is read.

    Raises:
        ValueError, OSError: the file cannot be read.
    """
    file = Path(path)
    if file.suffix.lower() not in SUFFIXES:
        return False
    if file.suffix.lower() == ".vrm":
        return True
    from spt_jax.files.limits import read_bytes
    from spt_jax.io.meshes.gltf_check import gltf_tree

    try:
        tree = gltf_tree(read_bytes(as_file(file, WHAT), WHAT, max_bytes=max_bytes), file)
        return any("skin" in node and "mesh" in node for node in tree.get("nodes", ()))
    except (UnreadableError, TypeError, AttributeError):
        return False  # the reader of meshes says what is wrong with it


def _read(file: Path, scale: float | None, dtype: np.dtype, max_bytes: int | None) -> list[RigFile]:
    document = open_document(file, max_bytes)
    nodes, common = read_nodes(document), []
    skins = read_skins(document, nodes)
    weights = default_weights(document)
    counts = {node: len(values) for node, values in weights.items()}
    animations = read_animations(document, len(nodes.names), counts, common)
    moved = {c.node for a in animations for c in a.channels if c.path != "weights"}
    characters = find_characters(document, nodes, skins, moved, common)
    if not characters:
        raise UnreadableError(
            "it must have a mesh with a skin: got none; export the armature with the mesh, or read "
            "it as a mesh (read_mesh, `spt-jax check`)"
        )
    found, names = [], [character.name for character in characters]
    for number, character in enumerate(characters):
        notes = list(common)
        built = build(document, nodes, skins, character, animations, dtype, scale, notes)
        own = {node: weights[node] for node in built.targets}
        mine = tuple(a for a in animations if _moves(a, built))
        name = character.name if names.count(character.name) == 1 else f"{character.name} {number}"
        found.append(
            RigFile(
                file,
                name,
                built.body,
                tuple(animation.name for animation in mine),
                tuple(dict.fromkeys(notes)),
                built.rows,
                document,
                built,
                mine,
                own,
            )
        )
    return found


def _moves(animation: Animation, built: Built) -> bool:
    return any(c.node in built.joints.place or c.node in built.targets for c in animation.channels)
