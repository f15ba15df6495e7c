"""`spt-jax untangle FILE --together`: the people of a pose file as scenes, frame by frame."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from spt_jax.cli.frames import Frame, Motion, as_report, made_from, print_summary, untangle_frames
from spt_jax.cli.motions import Chosen, write_motions
from spt_jax.cli.posed import posed_on
from spt_jax.cli.terminal import (
    err_console,
    progress_bar,
    show,
    user_errors,
    warnings_as,
)

if TYPE_CHECKING:
    from rich.table import Table

    from spt_jax.body import BodyModel

_CUBIC_CENTIMETRES = 1e6


class Scenes(NamedTuple):
    """Frames in which some people are.

    Attributes:
        numbers: of the frames.
        rows: of each frame, which of the frames asked for it is made of, a person each.
    """

    numbers: list[int]
    rows: list[list[int]]


class Counted(NamedTuple):
    """Overlap between people and within them, before and after: cubic metres, and pairs."""

    between: tuple[tuple[float, int], tuple[float, int]]
    within: tuple[tuple[float, int], tuple[float, int]]


def scenes_of(asked: Chosen) -> Scenes:
    """The frames asked for by their number: that which the file gives them, or their place.

    Raises:
        ValueError: people whose place the file does not say.
    """
    missing = [track.name for track in asked.tracks if track.translation is None]
    if missing:
        raise ValueError(
            f"together needs to know where people are: got {missing[0]!r} without a translation in "
            f"{str(asked.file.path)!r}; leave --together out, and each is freed for itself."
        )
    found: dict[int, list[int]] = {}
    for at, (k, row) in enumerate(asked.rows):
        numbers = asked.tracks[k].frames
        found.setdefault(row if numbers is None else int(numbers[row]), []).append(at)
    numbers = sorted(found)
    return Scenes(numbers, [sorted(found[n], key=lambda at: asked.rows[at][0]) for n in numbers])


def untangle_together(
    asked: Chosen,
    body: str,
    folder: Path,
    options: dict[str, Any],
    *,
    meshes: bool,
    anew: bool,
    max_bytes: int | None,
    json: bool,
    quiet: bool,
) -> int:
    """Free the people of each frame of themselves and of each other; the exit code is 0."""
    from spt_jax.cli.frames import write_meshes
    from spt_jax.cli.unfinished import UnfinishedRun, manifest_of
    from spt_jax.files.outputs import write_json

    with user_errors():
        scenes = scenes_of(asked)
    with progress_bar(len(scenes.numbers), quiet) as state:
        state("loading the body")
        said: list[str] = []
        with user_errors(), warnings_as(said):
            model, motion, notes = posed_on(asked, body, max_bytes)
        notes = said + notes
        for note in notes:
            show(err_console(quiet), f"note: {note}", "yellow")
        whole = [_scene(model, motion, scenes, k) for k in range(len(scenes.numbers))]
        with user_errors():
            items = [made_from(one)[0] for one in whole]
            settings = options | {"together": True}
            manifest = manifest_of("untangle", settings, model, items)
            run = UnfinishedRun(folder, manifest, say=partial(show, err_console(quiet)), anew=anew)
        with run:
            done, counted = [], []
            for k, one in enumerate(whole):
                group = _group(model, len(scenes.rows[k]))
                done += untangle_frames(
                    group,
                    one,
                    **options,
                    state=state,
                    run=_Item(run, k),  # pyright: ignore[reportArgumentType]
                    keep_vertices=True,
                )
                state(one.names[0], done=k + 1)
                counted.append(_counted(group, done[-1], options))
            report = as_report("untangle", done, {"poses": str(asked.file.path), "body": body})
            report["settings"] |= settings
            for entry, count, rows in zip(report["frames"], counted, scenes.rows, strict=True):
                entry |= _as_entry(count, [asked.tracks[asked.rows[at][0]].name for at in rows])
            with user_errors():
                report["meshes"] = []
                if meshes:
                    for frame, rows in zip(done, scenes.rows, strict=True):
                        faces = _group(model, len(rows)).faces
                        report["meshes"] += write_meshes(folder, [frame], faces, (".glb",))
                people, moved = _apart(model, motion, scenes, done)
                files = write_motions(folder, people, moved, asked)
                report |= {"structure": asked.file.structure, "files": files, "notes": notes}
                write_json(folder / "report.json", report)
                run.finish()
    table, line = _table(done, counted, scenes), _summary(done, counted)
    print_summary(done, report, folder, json=json, quiet=quiet, table=table, line=line)
    return 0


class _Item:
    """One item of an unfinished run, where the frames' number begins at 0 again."""

    def __init__(self, run: Any, item: int):
        self._run, self._item = run, item

    def found(self, _: int) -> Any:
        return self._run.found(self._item)

    def keep(self, _: int, arrays: Any) -> None:
        self._run.keep(self._item, arrays)


def _group(model: "BodyModel", count: int) -> Any:
    from spt_jax.body import BodyGroup

    return BodyGroup(model, count)


def _scene(model: "BodyModel", motion: Motion, scenes: Scenes, k: int) -> Motion:
    rows = scenes.rows[k]
    places = np.zeros((len(rows), 3)) if motion.translation is None else motion.translation[rows]
    pose = np.asarray(_group(model, len(rows)).pose_of(motion.pose[rows], places))
    shape = None if motion.shape is None else motion.shape[rows].reshape(1, -1)
    return Motion([f"frame/{scenes.numbers[k]:04d}"], pose[None], shape, None)


def _counted(group: Any, frame: Frame, options: dict[str, Any]) -> Counted:
    from spt_jax._exclusions import as_fold_surface
    from spt_jax._report import intersection_report

    rest = None
    if options["folds"] == "ignore":
        rest = as_fold_surface(group, options["fold_distance"])
    found = []
    for ignored in (group.within, group.between):
        row = []
        for vertices in (frame.vertices_before, frame.vertices_after):
            report = intersection_report(
                vertices,
                group.faces,
                rays=options["rays"],
                face_groups=group.face_groups,
                ignore_groups=ignored,
                rest_surface=rest,
            )
            row.append((float(report.volume), int(report.intersecting_pairs)))
        found.append(tuple(row))
    return Counted(*found)


def _as_entry(count: Counted, names: list[str]) -> dict[str, Any]:
    found: dict[str, Any] = {"people": names}
    for kind, pair in count._asdict().items():
        found[kind] = {
            when: {"volume": volume, "intersecting_pairs": pairs}
            for when, (volume, pairs) in zip(("before", "after"), pair, strict=True)
        }
    return found


def _apart(
    model: "BodyModel", motion: Motion, scenes: Scenes, done: Sequence[Frame]
) -> tuple[list[Frame], Motion]:
    """The people of all scenes in the order asked for, and where they are now."""
    people: dict[int, Frame] = {}
    places = np.zeros((len(motion.names), 3), np.float32)
    for frame, rows in zip(done, scenes.rows, strict=True):
        poses, where = _group(model, len(rows)).people(frame.pose)
        for k, at in enumerate(rows):
            people[at] = replace(frame, name=motion.names[at], pose=np.asarray(poses[k]))
            places[at] = np.asarray(where[k])
    return [people[at] for at in range(len(motion.names))], replace(motion, translation=places)


def _table(done: Sequence[Frame], counted: Sequence[Counted], scenes: Scenes) -> "Table":
    from rich.table import Table

    table = Table(header_style="bold", padding=0, collapse_padding=True)
    table.add_column("frame", overflow="fold", min_width=6)
    headings = ("people", "between, cm³\nbefore", "\nafter", "within, cm³\nbefore", "\nafter")
    for heading in (*headings, "pairs\nbefore", "\nafter", "steps", "time"):
        table.add_column(heading, justify="right", no_wrap=True)
    for frame, count, rows in zip(done, counted, scenes.rows, strict=True):
        volumes = [f"{x[0] * _CUBIC_CENTIMETRES:.2f}" for pair in count for x in pair]
        pairs = (str(r.intersecting_pairs) for r in (frame.before, frame.after))
        words = (*volumes, *pairs, str(frame.steps), f"{frame.seconds:.1f} s")
        table.add_row(frame.name, str(len(rows)), *words)
    return table


def _summary(done: Sequence[Frame], counted: Sequence[Counted]) -> str:
    parts = []
    for kind in ("between", "within"):
        before, after = (
            sum(getattr(count, kind)[when][0] for count in counted) * _CUBIC_CENTIMETRES
            for when in (0, 1)
        )
        parts.append(f"{before:.2f} cm³ {kind} people before, {after:.2f} cm³ after")
    count = "1 frame" if len(done) == 1 else f"{len(done)} frames"
    free = sum(frame.is_free for frame in done)
    return f"{count}, {free} collision-free: {'; '.join(parts)}"
