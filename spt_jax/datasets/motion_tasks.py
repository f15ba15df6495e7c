"""What is done with each pose file of a folder: its motions measured, or freed of collisions.

Engines pickle a task once and call its `work` for every file; `motions.py` has the functions that
make the tasks.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from spt_jax.datasets.arguments import as_body_key
from spt_jax.datasets.figures import file_figures, overlap_figures, worst_frame
from spt_jax.datasets.items.work import Report, UnknownFileError
from spt_jax.io.poses.reading import SUFFIXES, UnknownStructureError, open_poses
from spt_jax.metrics import MotionOverlap, motion_overlap

if TYPE_CHECKING:
    from spt_jax.body import BodyModel
    from spt_jax.datasets.items.inventory import Inventory
    from spt_jax.datasets.items.store import Store
    from spt_jax.datasets.tracks import Posed
    from spt_jax.io.poses.track import MotionFile, Track
    from spt_jax.rest.surface import RestSurface

# More shape components than AMASS and BEDLAM write, fewer than take long to load.
_SHAPE_COMPONENTS = 16
# As many as Motion-X writes, the most of all pose files.
_EXPRESSIONS = 50


@dataclass
class MeasureMotions:
    """The overlap of each frame of each file, and nothing changed.

    Attributes:
        body: "anny", or the path of a body model.
        fold_distance: as in `untangle_motion`.
        max_bytes: what a file may take.
        pictures: how many of the worst files the report shows pictures of.
    """

    body: str = "anny"
    fold_distance: float | None = None
    max_bytes: int | None = None
    pictures: int = 10
    name: str = field(default="measure", init=False)

    def settings(self) -> dict[str, Any]:
        """All that a figure depends on."""
        return {"body": as_body_key(self.body), "fold_distance": self.fold_distance}

    def wants(self, path: Path) -> bool:
        """Whether the suffix is one of pose files."""
        return path.suffix.lower() in SUFFIXES

    def are_one(self, paths: Sequence[Path]) -> bool:
        """Whether numbered files hold the frames of one motion: the first and the last hold one."""
        try:
            files = [open_poses(path, max_bytes=self.max_bytes) for path in (paths[0], paths[-1])]
        except (ValueError, OSError):
            return False
        return all(len(track.pose) == 1 for file in files for track in file.tracks)

    def start(self) -> None:
        """Load the body."""
        from spt_jax._exclusions import as_fold_surface
        from spt_jax.body import expression_as_shape, load_body

        body = load_body(
            self.body,
            num_shape=_SHAPE_COMPONENTS,
            num_expression=_EXPRESSIONS,
            max_bytes=self.max_bytes,
        )
        self.expressions: int = body.num_expression
        self.body_model: BodyModel = expression_as_shape(body)
        self.rest_surface: RestSurface = as_fold_surface(self.body_model, self.fold_distance)

    def work(self, path: Path, out: Path, report: Report) -> dict[str, Any]:
        """The figures of a file's people."""
        file = self._opened(path)
        total = sum(len(track.pose) for track in file.tracks)
        people, done = [], 0
        for track in file.tracks:
            overlap = self._measured(track, done, total, report)
            found = {"person": track.name, "frames": len(track.pose)}
            found |= {"worst_frame": worst_frame(overlap), **overlap_figures(overlap)}
            people.append(found | {"frame_rate": track.frame_rate})
            done += len(track.pose)
        return self._row(file, people, file.notes)

    def prepare(self) -> None:
        """Load the body, if it is not there."""
        if not hasattr(self, "body_model"):
            self.start()

    def draw(self, store: "Store", found: "Inventory", rows: list[dict[str, Any]]) -> str:
        """Draw the worst frames for the report; why there are no pictures, if there are none."""
        from spt_jax.datasets.pictures import draw_worst

        return draw_worst(self, store, found.items, rows)

    def posed(self, track: "Track", body: "BodyModel") -> "Posed":
        """A track on the body, or on one made from it."""
        from spt_jax.datasets.tracks import on_body

        embedded = self.body == "anny"
        return on_body(track, body, embedded=embedded, expressions=self.expressions)

    def _opened(self, path: Path) -> "MotionFile":
        try:
            return open_poses(path, max_bytes=self.max_bytes)
        except UnknownStructureError as error:
            raise UnknownFileError(str(error)) from error

    def _measured(self, track: "Track", done: int, total: int, report: Report) -> MotionOverlap:
        from spt_jax.datasets.tracks import skins

        posed = self.posed(track, self.body_model)
        faces = np.asarray(self.body_model.faces)
        pieces = []
        for vertices in skins(self.body_model, posed):
            pieces.append(motion_overlap(vertices, faces, rest_surface=self.rest_surface))
            done += len(vertices)
            report(done, total, track.name)
        columns = zip(*(piece.columns() for piece in pieces), strict=True)
        return MotionOverlap(*(np.concatenate(column) for column in columns))

    def _row(self, file: "MotionFile", people: list[dict[str, Any]], notes: Any) -> dict[str, Any]:
        worst = max(people, key=lambda one: one.get("largest_depth_before", 0.0))
        return {
            "structure": file.structure,
            **file_figures(people),
            "worst_person": worst["person"],
            "worst_frame": worst["worst_frame"],
            "frame_rate": people[0]["frame_rate"],
            "notes": list(dict.fromkeys(notes)),
            "people": people,
        }


@dataclass
class CleanMotions(MeasureMotions):
    """Each file with the nearest poses that do not collide, as smooth as it was.

    Attributes:
        structure: "input" writes each file again in its own structure, "amass" an .npz a person.
        frame_rate: of files that say none, in frames a second.
        fade, margin, feet: as in `untangle_motion`.
    """

    structure: Literal["input", "amass"] = "input"
    frame_rate: float = 30.0
    fade: float = 0.02
    margin: float = 0.002
    feet: float = 20.0
    name: str = field(default="clean", init=False)

    def settings(self) -> dict[str, Any]:
        """All that a result depends on."""
        own = ("structure", "frame_rate", "fade", "margin", "feet")
        return super().settings() | {key: getattr(self, key) for key in own}

    def work(self, path: Path, out: Path, report: Report) -> dict[str, Any]:
        """Free a file's people, and write them."""
        file = self._opened(path)
        total = sum(len(track.pose) for track in file.tracks)
        people, poses, notes, done = [], {}, list(file.notes), 0
        for track in file.tracks:
            found, pose, said = self._freed(track, done, total, report)
            people.append(found)
            poses[track.name] = pose
            notes += said
            done += len(track.pose)
        report(total, total, "writing")
        notes += self._write(file, poses, out)
        return self._row(file, people, notes)

    def _freed(
        self, track: "Track", done: int, total: int, report: Report
    ) -> tuple[dict[str, Any], np.ndarray, tuple[str, ...]]:
        from spt_jax.datasets.tracks import (
            displacements,
            in_track,
            second_differences,
        )
        from spt_jax.untangle.motion import MotionStep, untangle_motion
        from spt_jax.untangle.motion_input import up_of

        body = self._writable(track)
        posed = self.posed(track, body)
        up = up_of(body, posed.pose)

        def on_step(step: MotionStep) -> None:
            report(done + step.first, total, f"{track.name}: {step.colliding} frames collide")

        report(done, total, track.name)
        result = untangle_motion(
            body,
            posed.pose,
            shape=posed.shape,
            # Without one, feet stand where they are lowest in each frame.
            translation=None if track.translation is None else posed.translation,
            frames_per_second=track.frame_rate or self.frame_rate,
            fade=self.fade,
            fold_distance=self.fold_distance,
            margin=self.margin,
            feet=self.feet,
            up=up,
            on_step=on_step,
        )
        after = posed._replace(pose=np.asarray(result.pose))
        moved = bool(np.any(result.moved))
        rough = second_differences(body, posed)
        rougher = second_differences(body, after) if moved else rough
        mean, largest = displacements(body, posed, after) if moved else (0.0, 0.0)
        found = {
            "person": track.name,
            "frames": len(track.pose),
            "moved_frames": int(np.count_nonzero(result.moved)),
            "worst_frame": worst_frame(result.before),
            **overlap_figures(result.before, "_before"),
            **overlap_figures(result.after, "_after"),
            "mean_displacement": mean,
            "largest_displacement": largest,
            "mean_second_difference_before": rough[0],
            "mean_second_difference_after": rougher[0],
            "largest_second_difference_before": rough[1],
            "largest_second_difference_after": rougher[1],
            "frame_rate": track.frame_rate,
        }
        return found, in_track(track, body, posed.pose, after.pose), posed.notes

    def _writable(self, track: "Track") -> "BodyModel":
        """The body with the joints that can be written: those that the file has a place for."""
        from spt_jax.body.poses import SMPL_LAYOUTS
        from spt_jax.datasets.restricted import restricted

        layout = SMPL_LAYOUTS[track.pose.shape[1]]
        known = range(len(layout))
        if self.structure == "input" and track.blocks:
            known = sorted({joint for block in track.blocks for joint in block.joints})
        names = tuple(layout[k] for k in known)
        bodies: dict[tuple[str, ...], BodyModel] = self.__dict__.setdefault("_bodies", {})
        if names not in bodies:
            bodies[names] = restricted(self.body_model, names)
        return bodies[names]

    def _write(self, file: "MotionFile", poses: dict[str, np.ndarray], out: Path) -> list[str]:
        if self.structure == "input":
            return list(file.write(out / file.path.name, poses))
        from spt_jax.io.pose_files import write_poses

        # The suffix stays where it tells files apart: a.npz and a.pkl may lie beside each other.
        stem = file.path.stem if file.path.suffix.lower() == ".npz" else file.path.name
        for number, track in enumerate(file.tracks):
            person = f"_{number}" if len(file.tracks) > 1 else ""
            write_poses(
                out / f"{stem}{person}.npz",
                poses[track.name],
                shape=track.shape,
                expression=track.expression,
                translation=track.translation,
                names=track.names,
                frame_rate=track.frame_rate,
                gender=track.gender,
            )
        return []
