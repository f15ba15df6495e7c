"""Frames untangled one after the other, with what is shown and written of them."""

import json as json_format
import re
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from spt_jax.cli.terminal import State, measurable, out_console, show, user_errors

if TYPE_CHECKING:
    from rich.table import Table

    from spt_jax._report import IntersectionReport
    from spt_jax.body import AbstractBody
    from spt_jax.cli.unfinished import UnfinishedRun
    from spt_jax.untangle.pose import Folds

_CUBIC_CENTIMETRES = 1e6  # in a cubic metre


@dataclass(frozen=True)
class Motion:
    """Frames of one body: names, poses in the body's own joints, and what goes with them.

    Of the shape's columns the last `expressions` are those of the face.
    """

    names: list[str]
    pose: Float[np.ndarray, "N J 3"]
    shape: Float[np.ndarray, "N B"] | None = None
    translation: Float[np.ndarray, "N 3"] | None = None
    expressions: int = 0


@dataclass(frozen=True)
class Frame:
    """One frame before and after."""

    name: str
    pose: Float[np.ndarray, "J 3"]
    vertices_before: Float[np.ndarray, "V 3"]
    vertices_after: Float[np.ndarray, "V 3"]
    before: "IntersectionReport"
    after: "IntersectionReport"
    steps: int
    seconds: float
    is_free: bool
    reason: str

    @property
    def file_name(self) -> str:
        """The name as a part of a file's name: "crawl/0012" becomes "crawl_0012"."""
        return re.sub(r"[^\w.-]+", "_", self.name).lstrip(".") or "frame"


def made_from(motion: Motion) -> list[tuple[str, list[Any]]]:
    """The name of each frame, and all that its result is made from."""
    rows = (motion.shape, motion.translation)
    return [
        (name, [name, motion.pose[k], *(None if row is None else row[k] for row in rows)])
        for k, name in enumerate(motion.names)
    ]


def untangle_frames(
    body: "AbstractBody",
    motion: Motion,
    *,
    rays: int | None,
    directions: int,
    folds: "Folds",
    fold_distance: float | None = None,
    contacts: str | None = None,
    state: State,
    run: "UnfinishedRun | None" = None,
    keep_vertices: bool = True,
) -> list[Frame]:
    """Report on each frame, untangle it, and report again; folds that stay are left out.

    Args:
        run: keeps each frame as it is done, and has those that were done before.
        keep_vertices: whether it keeps the vertices too; where not, those frames have none.
    """
    from spt_jax._exclusions import as_fold_surface
    from spt_jax._report import intersection_report
    from spt_jax._steps import Step
    from spt_jax.cli.kept import frame_arrays, frame_of
    from spt_jax.untangle.pose import untangle_pose

    rest = as_fold_surface(body, fold_distance) if folds == "ignore" else None
    asked = {"rays": rays, "directions": directions, "rest_surface": rest}
    frames = []
    for k, name in enumerate(motion.names):
        state(name, done=k)
        kept = None if run is None else run.found(k)
        if kept is not None:
            frames.append(frame_of(kept))
            continue
        start = time.perf_counter()
        shape = None if motion.shape is None else motion.shape[k]
        translation = None if motion.translation is None else motion.translation[k]

        def on_step(step: Step, name: str = name) -> None:
            # Without the volume, which costs as much as the step itself.
            state(f"{name}: weight {step.stage + 1}, step {step.steps}")

        vertices = np.asarray(body(motion.pose[k], shape, translation).vertices)
        with measurable(name):
            before = intersection_report(vertices, body.faces, **asked)
            result = untangle_pose(
                body,
                motion.pose[k],
                shape=shape,
                translation=translation,
                folds=folds,
                fold_distance=fold_distance,
                contacts=contacts,
                # It measures with twice as many as it searches with.
                rays=rays if rays is None else max(rays // 2, 1),
                directions=directions,
                on_step=on_step,
            )
            untangled = np.asarray(result.vertices)
            after = intersection_report(untangled, body.faces, **asked)
        frames.append(
            Frame(
                name=name,
                pose=np.asarray(result.pose),
                vertices_before=vertices,
                vertices_after=untangled,
                before=before,
                after=after,
                steps=int(result.steps),
                seconds=time.perf_counter() - start,
                is_free=bool(result.is_free),
                reason=result.reason,
            )
        )
        if run is not None:
            arrays = frame_arrays(frames[-1], vertices=keep_vertices)
            with user_errors():
                run.keep(k, arrays)
    return frames


def before_after_table(frames: Sequence[Frame]) -> "Table":
    """The table that people read: one row a frame."""
    from rich.markup import escape
    from rich.table import Table

    # 80 columns have to do where the output is no terminal.
    table = Table(header_style="bold", padding=0, collapse_padding=True)
    table.add_column("frame", overflow="fold", min_width=6)
    headings = (
        "ratio\nbefore",
        "\nafter",
        "overlap, cm³\nbefore",
        "\nafter",
        "pairs\nbefore",
        "\nafter",
        "steps",
        "time",
    )
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for frame in frames:
        color = "green" if frame.after.volume < 0.01 * frame.before.volume else "default"
        table.add_row(
            escape(frame.name),
            f"{frame.before.ratio:.2%}",
            f"[{color}]{frame.after.ratio:.2%}[/{color}]",
            f"{frame.before.volume * _CUBIC_CENTIMETRES:.2f}",
            f"[{color}]{frame.after.volume * _CUBIC_CENTIMETRES:.2f}[/{color}]",
            str(frame.before.intersecting_pairs),
            f"[{color}]{frame.after.intersecting_pairs}[/{color}]",
            str(frame.steps),
            f"{frame.seconds:.1f} s",
        )
    return table


def summary(frames: Sequence[Frame]) -> str:
    """All frames in one line."""
    before, after = (
        sum(getattr(frame, when).volume for frame in frames) * _CUBIC_CENTIMETRES
        for when in ("before", "after")
    )
    change = f" ({after / before - 1:+.2%})" if before else ""
    count = "1 frame" if len(frames) == 1 else f"{len(frames)} frames"
    pairs = sum(frame.after.intersecting_pairs for frame in frames)
    free = sum(frame.is_free for frame in frames)
    left = f"; {pairs} intersecting pairs left" if pairs else "; no intersecting pairs left"
    return (
        f"{count}, {free} collision-free: {before:.2f} cm³ of overlap before, {after:.2f} cm³ after"
        f"{change}{left}"
    )


def left_out(before: Iterable["IntersectionReport"], after: Iterable["IntersectionReport"]) -> str:
    """What is left out of all reports as folds, in one line.

    Args:
        before, after: the reports; where there was nothing to compare with, the first are none.
    """
    parts = []
    for when, reports in (("before", list(before)), ("after", list(after))):
        if reports:
            volume = sum(report.total_volume - report.volume for report in reports)
            pairs = sum(r.total_intersecting_pairs - r.intersecting_pairs for r in reports)
            parts.append(
                (f"{volume * _CUBIC_CENTIMETRES:.2f} cm³ and {pairs} intersecting pairs", when)
            )
    if len(parts) == 1:
        return f"left out as folds: {parts[0][0]}"
    return "left out as folds: " + ", ".join(f"{what} {when}" for what, when in parts)


def print_summary(
    frames: Sequence[Frame],
    report: dict[str, Any],
    folder: Path,
    *,
    json: bool,
    quiet: bool,
    table: "Table | None" = None,
    line: str | None = None,
) -> None:
    """Print what came of frames: the report as JSON, or a table, a summary and what was written.

    Args:
        frames: what was done.
        report: with the names of the "meshes" and "files" written.
        folder: where they are.
        json: print the report.
        quiet: print errors alone.
        table: in place of `before_after_table`.
        line: in place of `summary`.
    """
    if json:
        print(json_format.dumps(report, indent=2))
        return
    console = out_console(quiet)
    console.print(before_after_table(frames) if table is None else table)
    show(console, summary(frames) if line is None else line)
    show(console, left_out((f.before for f in frames), (f.after for f in frames)))
    also = f", {len(report['meshes'])} meshes (.glb)" if report["meshes"] else ""
    show(console, f"in {folder}: {', '.join(report['files'])}, report.json{also}")


def as_report(command: str, frames: Sequence[Frame], settings: dict[str, Any]) -> dict[str, Any]:
    """What report.json holds."""
    return {
        "command": command,
        "versions": versions(),
        "settings": settings,
        "units": {"length": "m", "volume": "m^3", "time": "s", "angle": "rad"},
        "frames": [
            {
                "name": frame.name,
                "before": frame.before.as_dict(),
                "after": frame.after.as_dict(),
                "is_free": frame.is_free,
                "reason": frame.reason,
                "steps": frame.steps,
                "seconds": round(frame.seconds, 3),
            }
            for frame in frames
        ],
    }


def write_meshes(
    folder: Path, frames: Sequence[Frame], faces: Any, suffixes: Sequence[str]
) -> list[str]:
    """Write each frame's meshes before and after, colored by label; return the files' names."""
    from spt_jax.io.mesh_files import write_mesh

    names, written = _file_names(frames), []
    for frame, name in zip(frames, names, strict=True):
        for when, vertices, report in (
            ("before", frame.vertices_before, frame.before),
            ("after", frame.vertices_after, frame.after),
        ):
            for suffix in suffixes:
                written.append(f"{name}_{when}{suffix}")
                write_mesh(folder / written[-1], vertices, np.asarray(faces), report.labels)
    return written


def write_motion(path: Path, frames: Sequence[Frame], motion: Motion) -> None:
    """Write the untangled poses, with the shapes and translations that came with them."""
    from spt_jax.io.pose_files import write_poses

    write_poses(
        path,
        np.stack([frame.pose for frame in frames]),
        shape=motion.shape,
        translation=motion.translation,
        names=motion.names,
    )


def _file_names(frames: Sequence[Frame]) -> list[str]:
    names = [frame.file_name for frame in frames]
    # "a/b" and "a_b" would share a file.
    return [name if names.count(name) == 1 else f"{name}_{k}" for k, name in enumerate(names)]


def versions() -> dict[str, str]:
    """Of Python, of this package and of those that its numbers depend on."""
    import platform

    found = {"python": platform.python_version(), "platform": platform.platform()}
    for package in ("spt-jax", "jax", "jaxlib", "numpy", "equinox", "optimistix"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:  # run from a folder of sources
            found[package] = "not installed"
    return found
