"""What becomes of an opened file: a scene, the motions that it can show, and what begins.

Poses are shown on the body that is there, a character with its own animations, and a body with the
embedded motion capture. `files.py` opens the files, `server.py` shows what comes of them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spt_jax._mesh_check import check_mesh
from spt_jax.body import AbstractBody, load_body
from spt_jax.io.pose_files import MotionFile
from spt_jax.view import files
from spt_jax.view.beside import Beside, matched
from spt_jax.view.scene import Scene

# A fist in the belly: something to untangle at first sight.
_FIRST = ("punch", "punch/0013")


class Shown(NamedTuple):
    """What a view begins with.

    Attributes:
        scene: the surface, and its body where it has one.
        motions: that the scene can go through, by name.
        start: the motion and the frame of it to begin with; None without motions.
        embedded: whether the body is the one that comes with the package.
        notes: what the user should know of the file.
    """

    scene: Scene
    motions: dict[str, files.Frames]
    start: tuple[str, int] | None
    embedded: bool
    notes: Sequence[str]


def as_shown(
    opened: Scene | MotionFile | files.Rigged,
    name: str | None,
    shown: Scene | None,
    *,
    embedded: bool,
) -> Shown:
    """What a view shows of an opened file.

    Args:
        opened: as `files.open_file` returns it, or a scene.
        name: of the file; None for the embedded body.
        shown: the scene whose body takes poses; the embedded body where None or without one.
        embedded: whether that body is the embedded one.
    """
    if isinstance(opened, MotionFile):
        scene = embedded_body() if shown is None else shown
        if scene.body is None:
            scene, embedded = embedded_body(), True
        own, notes = files.motions_of(
            opened,
            name or "poses",
            scene.body,  # type: ignore
            embedded=embedded,
        )
        motions = {**own, **files.mocap_for(scene.body)}  # type: ignore
        return Shown(scene, motions, (next(iter(own)), 0), embedded, notes)
    if isinstance(opened, files.Rigged):
        scene, motions = opened.scene, opened.motions
        start = (list(motions)[min(1, len(motions) - 1)], 0)  # the first animation
        problems = check_mesh(scene.vertices, scene.faces).problems
        return Shown(scene, motions, start, False, [*opened.notes, *problems])
    notes, embedded = (), name is None
    motions = {} if opened.body is None else files.mocap_for(opened.body)
    if opened.body is not None and not embedded:
        found = check_mesh(np.asarray(opened.body.template), opened.faces)  # type: ignore
        notes = found.problems or found.warnings[: found.holes > 0]
    start = (_FIRST[0], motions[_FIRST[0]].names.index(_FIRST[1])) if motions else None
    return Shown(opened, motions, start, embedded, notes)


def as_beside(
    opened: MotionFile,
    other: MotionFile,
    name: str,
    body: AbstractBody,
    motions: Sequence[str],
    *,
    embedded: bool,
) -> tuple[Beside, Sequence[str]]:
    """What stands beside the motions of a file, and what the user should know of it.

    Args:
        opened, other: the two files.
        name: of the other one.
        body: that both are shown on.
        motions: the names under which those of the first are shown, and further ones.
        embedded: whether the body is the embedded one.
    """
    shown, _ = files.motions_of(opened, "", body, embedded=embedded)  # type: ignore
    named = dict(zip(motions, shown.values(), strict=False))  # the file's come first
    others, notes = files.motions_of(other, "", body, embedded=embedded)  # type: ignore
    return Beside(body, name, matched(named, others)), notes


def embedded_body() -> Scene:
    """The body that comes with the package."""
    return Scene.of_body(load_body(), "the embedded body")
