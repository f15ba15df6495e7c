"""`spt-jax untangle` where frames follow each other: what is done, printed and written."""

import json as json_format
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from spt_jax.cli.frames import Motion, made_from
from spt_jax.cli.motion_frames import (
    Piece,
    as_motion_report,
    chosen_up,
    counted_apart,
    motions_summary,
    motions_table,
    poses_of,
    rate_of,
    remove_kept,
    untangle_pieces,
    write_animations,
)
from spt_jax.cli.motions import Chosen, write_like_input, write_motions
from spt_jax.cli.terminal import State, err_console, out_console, show, user_errors
from spt_jax.cli.unfinished import UnfinishedRun, manifest_of
from spt_jax.files.outputs import write_json

if TYPE_CHECKING:
    from spt_jax.body import BodyModel


class MotionOptions(NamedTuple):
    """What `spt-jax untangle` was asked for, as far as motions go."""

    fold_distance: float | None
    contacts: str | None
    fps: float | None
    up: str
    meshes: bool
    like_input: bool
    anew: bool
    json: bool
    quiet: bool


def untangle_as_motions(
    body: "BodyModel",
    motion: Motion,
    asked: Chosen,
    pieces: Sequence[Piece],
    folder: Path,
    notes: list[str],
    wanted: MotionOptions,
    state: State,
    named: str,
) -> int:
    """Free the motions of a file and write what became of them; the exit code.

    Args:
        body, motion: as frames are untangled.
        asked: the file, and what of it.
        pieces: the motions.
        folder: for the results.
        notes: what was said of the file so far.
        wanted: the options.
        state: of the progress bar.
        named: the body, as it was asked for.
    """
    say = partial(show, err_console(wanted.quiet))
    with user_errors():
        rate, unknown = rate_of(asked, wanted.fps)
        up, guessed = chosen_up(body, motion, wanted.up)
    fresh = [note for note in (unknown, guessed) if note is not None]
    if len(pieces) == 1 and len(pieces[0].rows) > 1:
        fresh.append(f"{len(pieces[0].rows)} people as one scene; none is moved as a whole")
    for note in fresh:
        say(f"note: {note}", "yellow")
    options = {
        "fold_distance": wanted.fold_distance,
        "contacts": wanted.contacts,
        "frames_per_second": rate,
        "up": up,
    }
    settings = options | {"as": "motions", "people": [len(piece.rows) for piece in pieces]}
    with user_errors():
        manifest = manifest_of("untangle", settings, body, made_from(motion))
        run = UnfinishedRun(folder, manifest, say=say, anew=wanted.anew)
        if wanted.anew:
            remove_kept(run.folder)
    with run:
        done = untangle_pieces(body, motion, pieces, options=options, state=state, run=run)
        state("writing")
        report = as_motion_report(done, motion.names, {"poses": str(asked.file.path), **settings})
        report["settings"]["body"] = named
        report["structure"] = asked.file.structure
        frames = poses_of(done, len(motion.names))
        with user_errors():
            files = write_motions(folder, frames, motion, asked)
            if wanted.like_input:
                names = body.joint_names
                name, stale = write_like_input(folder, frames, motion, asked, names)
                files.append(name)
                for note in stale:
                    say(f"note: {note}", "yellow")
                fresh += stale
            if wanted.meshes:
                report["animations"] = write_animations(folder, body, motion, done, rate)
            report["files"], report["notes"] = files, notes + fresh
            write_json(folder / "report.json", report)
            remove_kept(run.folder)
    if wanted.json:
        print(json_format.dumps(report, indent=2))
        return 0
    console = out_console(wanted.quiet)
    console.print(motions_table(done))
    show(console, motions_summary(done))
    for line in counted_apart(done):
        show(console, line)
    show(console, "folds are left as they are")
    also = f", {', '.join(report['animations'])}" if wanted.meshes else ""
    show(console, f"in {folder}: {', '.join(files)}, report.json{also}")
    return 0
