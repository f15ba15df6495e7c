"""Motions of a pose file freed as a whole: which frames belong together, and how they come out."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from spt_jax.cli.frames import Motion, versions
from spt_jax.cli.motions import Chosen
from spt_jax.cli.terminal import State, user_errors
from spt_jax.untangle.motion_input import up_of

if TYPE_CHECKING:
    from rich.table import Table

    from spt_jax.body import BodyModel
    from spt_jax.cli.unfinished import UnfinishedRun
    from spt_jax.untangle.motion import MotionResult, MotionStep

# Where a file does not say.
RATE = 30.0

_UP = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}

# How much of a motion's work its measuring, freeing and checking are, roughly.
_SHARES = {"measuring": (0.0, 0.25), "freeing": (0.25, 0.65), "checking": (0.9, 0.1)}


class Piece(NamedTuple):
    """Frames that follow each other, of one person or of several at the same time.

    Attributes:
        name: that of the first frame, and the people.
        rows: of each person the numbers of the frames in what was asked for.
    """

    name: str
    rows: tuple[tuple[int, ...], ...]


class Posed(NamedTuple):
    """A frame, as what writes motions takes it."""

    pose: Float[np.ndarray, "J 3"]


class Freed(NamedTuple):
    """A piece and what became of it; seconds are of the clock."""

    piece: Piece
    result: "MotionResult"
    moved: float
    seconds: float

    @property
    def speed(self) -> float:
        """Frames a second."""
        return len(self.result.moved) / max(self.seconds, 1e-9)


def pieces_of(asked: Chosen, *, together: bool) -> list[Piece]:
    """The frames asked for, cut where one does not follow the other.

    Args:
        asked: which they are.
        together: whether people whose frames are the same, and who have a place, are one scene.
    """
    runs: list[list[int]] = []
    for at, (k, row) in enumerate(asked.rows):
        track, before = asked.tracks[k], asked.rows[at - 1] if at else (-1, -1)
        follows = before == (k, row - 1) and _same_motion(track, row)
        if not follows:
            runs.append([])
        runs[-1].append(at)
    if together and len(asked.tracks) > 1 and _is_scene(asked, runs):
        people = ", ".join(track.name for track in asked.tracks)
        return [Piece(people, tuple(tuple(run) for run in runs))]
    return [Piece(asked.names[run[0]], (tuple(run),)) for run in runs]


def _same_motion(track: Any, row: int) -> bool:
    one, other = (track.names[k].rpartition("/")[0] for k in (row - 1, row))
    follows = track.frames is None or track.frames[row] == track.frames[row - 1] + 1
    return one == other and bool(follows)


def _is_scene(asked: Chosen, runs: list[list[int]]) -> bool:
    frames = [tuple(asked.rows[at][1] for at in run) for run in runs]
    return (
        len(runs) == len(asked.tracks)
        and len(set(frames)) == 1
        and all(track.translation is not None for track in asked.tracks)
    )


def rate_of(asked: Chosen, fps: float | None) -> tuple[float, str | None]:
    """Frames a second, and a note where nobody says."""
    rates = {track.frame_rate for track in asked.tracks if track.frame_rate}
    if fps is not None:
        return float(fps), None
    if len(rates) > 1:
        raise ValueError(
            f"people must have one frame rate: got {sorted(rates)}; --people takes some, --fps "
            "says what holds."
        )
    if rates:
        return float(rates.pop()), None
    return RATE, f"the file has no frame rate; {RATE:g} frames a second are assumed (--fps)"


def chosen_up(body: "BodyModel", motion: Motion, up: str) -> tuple[tuple[float, ...], str | None]:
    """The direction that is up, and a note where it is inferred from the positions of the heads.

    Raises:
        ValueError: something that is no axis.
    """
    name = up.removeprefix("-").removeprefix("+")
    if up != "auto":
        if name not in _UP:
            raise ValueError(f'up must be x, y, z, one of them with a "-", or auto: got {up!r}.')
        return tuple(float(-x if up.startswith("-") else x) for x in _UP[name]), None
    direction = up_of(body, motion.pose)
    axis = int(np.abs(direction).argmax())
    sign = "-" if direction[axis] < 0 else ""
    said = f"up is taken to be {sign}{'xyz'[axis]}, where heads are above hips (--up)"
    return direction, said


def untangle_pieces(
    body: "BodyModel",
    motion: Motion,
    pieces: Sequence[Piece],
    *,
    options: dict[str, Any],
    state: State,
    run: "UnfinishedRun",
) -> list[Freed]:
    """Free each piece; windows that are done are kept in the run's folder, whatever ends it."""
    from spt_jax.untangle.motion import untangle_motion

    done, frames = [], 0
    for k, piece in enumerate(pieces):
        count = sum(map(len, piece.rows))

        def on_step(step: "MotionStep", name=piece.name, before=frames, count=count) -> None:
            start, share = _SHARES[step.stage]
            part = start + share * step.done / max(step.frames, 1)
            what = f"{step.stage}, {step.colliding} collide"
            if step.stage == "freeing":
                what = f"frames {step.first}-{step.end - 1}, round {step.round}, {what}"
            state(f"{name}: {what}", done=before + part * count)

        pose, shape, places = (
            _of_piece(array, piece) for array in (motion.pose, motion.shape, motion.translation)
        )
        start = time.perf_counter()
        with user_errors():
            result = untangle_motion(
                body,
                pose,
                shape=shape,
                translation=places,
                resume=run.folder / f"motion_{k:03d}",
                on_step=on_step,
                **options,
            )
        seconds = time.perf_counter() - start
        done.append(Freed(piece, result, _moved(body, pose, result, shape), seconds))
        frames += count
        state(piece.name, done=frames)
    return done


def _of_piece(array: Any, piece: Piece) -> Any:
    if array is None:
        return None
    people = np.stack([array[list(rows)] for rows in piece.rows], axis=1)
    return people if len(piece.rows) > 1 else people[:, 0]


def _moved(body, pose, result, shape) -> float:
    """The mean displacement of the skin over the frames that collided, in metres."""
    at = np.flatnonzero(~result.before.is_free)
    total = 0.0
    for k in at:
        rest = None if shape is None else shape[k]
        before, after = (np.asarray(body(p[k], rest).vertices) for p in (pose, result.pose))
        total += float(np.linalg.norm(after - before, axis=-1).mean())
    return total / max(len(at), 1)


def poses_of(done: Sequence[Freed], count: int) -> list[Posed]:
    """The poses found, in the order of the frames asked for."""
    found: list[Posed | None] = [None] * count
    for one in done:
        pose = np.asarray(one.result.pose)
        pose = pose[:, None] if len(one.piece.rows) == 1 else pose
        for person, rows in enumerate(one.piece.rows):
            for frame, row in enumerate(rows):
                found[row] = Posed(pose[frame, person])
    return [one for one in found if one is not None]


def as_motion_report(done: Sequence[Freed], names: Sequence[str], settings: Any) -> dict[str, Any]:
    """What report.json holds."""
    return {
        "command": "untangle",
        "versions": versions(),
        "settings": settings,
        "units": {"length": "m", "volume": "m^3", "time": "s", "angle": "rad"},
        "motions": [
            {
                "name": one.piece.name,
                "people": len(one.piece.rows),
                "frame_names": [names[row] for row in one.piece.rows[0]],
                "mean_displacement": one.moved,
                "seconds": round(one.seconds, 3),
                **one.result.as_dict(),
            }
            for one in done
        ],
    }


def motions_table(done: Sequence[Freed]) -> "Table":
    """The table that people read: one row a motion."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(header_style="bold", padding=0, collapse_padding=True)
    table.add_column("motion", overflow="fold", min_width=6)
    for heading in (
        "frames",
        "collide\nbefore",
        "\nafter",
        "deepest, cm\nbefore",
        "\nafter",
        "moved,\nmm",
        "frames\na second",
    ):
        table.add_column(heading, justify="right", no_wrap=True)
    for one in done:
        before, after = one.result.before, one.result.after
        left = int((~np.asarray(one.result.is_free)).sum())
        table.add_row(
            escape(one.piece.name),
            str(len(before.volume)),
            str(int((~before.is_free).sum())),
            f"[{'red' if left else 'green'}]{left}[/]",
            f"{100 * before.largest_depth.max(initial=0.0):.1f}",
            f"{100 * after.largest_depth.max(initial=0.0):.1f}",
            f"{1e3 * one.moved:.1f}",
            f"{one.speed:.1f}",
        )
    return table


def motions_summary(done: Sequence[Freed]) -> str:
    """All motions in one line, and what the public rule says of them."""
    frames = sum(len(one.result.moved) for one in done)
    before, after = (
        sum(int((~getattr(one.result, when).is_free).sum()) for one in done)
        for when in ("before", "after")
    )
    rejected = [
        sum(getattr(one.result, when).is_rejected for one in done) for when in ("before", "after")
    ]
    return (
        f"{frames} frames, {before} collide before, {after} after; the public rule (5 cm once, or "
        f"3 cm in more than 10 frames) leaves out {rejected[0]} of {len(done)} before, "
        f"{rejected[1]} after"
    )


def counted_apart(done: Sequence[Freed]) -> list[str]:
    """Of several people, a line on the overlap within and between them."""
    lines = []
    for one in done:
        for name in ("within", "between"):
            both = getattr(one.result, name)
            if both is not None:
                frames = [int((~overlap.is_free).sum()) for overlap in both]
                what = "within people" if name == "within" else "between people"
                lines.append(f"{what}: {frames[0]} frames collide before, {frames[1]} after")
    return lines


def as_motions(
    pieces: Sequence[Piece], *, frame_by_frame: bool, folds: str, rays: int | None
) -> tuple[bool, str | None]:
    """Whether frames are freed as motions, and a note where an option speaks against it."""
    if frame_by_frame or max((len(piece.rows[0]) for piece in pieces), default=0) < 2:
        return False, None
    wrong = f"--folds {folds}" if folds != "ignore" else f"--rays {rays}"
    if folds == "ignore" and rays is None:
        return True, None
    return False, f"{wrong} is there for single poses alone: the motion is freed frame by frame"


def write_animations(
    folder: Path, body: "BodyModel", motion: Motion, done: Sequence[Freed], rate: float
) -> list[str]:
    """Write each motion before and after as one .glb that plays; return the files' names."""
    from spt_jax.show.animation import before_and_after, write_animation

    written = []
    for k, one in enumerate(done):
        written.append("motion.glb" if len(done) == 1 else f"motion_{k:03d}.glb")
        pose, shape, places = (
            _of_piece(array, one.piece) for array in (motion.pose, motion.shape, motion.translation)
        )
        after = np.asarray(one.result.pose)
        figures = before_and_after(pose, after, shape=shape, translation=places)
        write_animation(folder / written[-1], body, figures, rate)
    return written


def remove_kept(folder: Path) -> None:
    """What windows left in a run's folder."""
    import shutil

    for path in folder.glob("motion_[0-9][0-9][0-9]"):
        shutil.rmtree(path, ignore_errors=True)
