"""What `spt-jax fit` prints, writes and draws of people once they are fitted."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from spt_jax._report import IntersectionReport
from spt_jax._status import OUTSIDE, RESULTS, names_of
from spt_jax.cli.annotated import Annotated
from spt_jax.cli.frames import versions
from spt_jax.fit.problem import photograph

if TYPE_CHECKING:
    from rich.table import Table

    from spt_jax.body import BodyModel
    from spt_jax.fit.result import FitResult
    from spt_jax.rest.surface import RestSurface

_LARGEST_CANVAS = 2000  # pixels of a side, where there is no photograph
_CUBIC_CENTIMETRES = 1e6
_LEAST_NAME = 6  # characters of a line of a name, in the table


@dataclass(frozen=True)
class Fitted:
    """One person fitted."""

    given: Annotated
    pose: Float[np.ndarray, "J 3"]
    shape: Float[np.ndarray, "B"]
    translation: Float[np.ndarray, "3"]
    vertices: Float[np.ndarray, "V 3"]
    keypoints: Float[np.ndarray, "K 2"]
    distance: float  # of the root joint along the line of sight, in metres
    terms: dict[str, float]
    status: str  # a name of `spt_jax.RESULTS`
    reason: str
    steps: int
    seconds: float
    overlap: IntersectionReport | None = field(repr=False)

    @property
    def name(self) -> str:
        """Of the person."""
        return self.given.name

    @property
    def usable(self) -> bool:
        """Whether there is a body."""
        return self.overlap is not None

    @property
    def outside(self) -> bool:
        """Whether no photograph could show it: camera or keypoints are in wrong units."""
        return self.status in OUTSIDE

    @property
    def errors(self) -> Float[np.ndarray, "seen"]:
        """Distances of the points that were seen from where the body has them, in pixels."""
        person = self.given.person
        off = np.linalg.norm(self.keypoints - person.points, axis=1)
        return off[person.confidence > 0]


def _scaled(camera: Any, scale: float) -> Any:
    from spt_jax._camera import PinholeCamera

    parts = (camera.focal * scale, camera.center * scale, camera.rotation, camera.translation)
    return PinholeCamera(*(np.asarray(part, np.float32) for part in parts), near=camera.near)


def as_fitted(
    body: "BodyModel",
    one: Annotated,
    result: "FitResult",
    rest_surface: "RestSurface",
    seconds: float,
) -> Fitted:
    """One person's fit in NumPy, measured; no overlap where there is no body to measure."""
    from spt_jax._report import intersection_report
    from spt_jax.overlap.measure import Unmeasurable

    vertices = np.asarray(result.vertices)
    overlap = None
    if np.isfinite(vertices).all():
        with suppress(Unmeasurable):
            overlap = intersection_report(vertices, body.faces, rest_surface=rest_surface)
    root = np.asarray(one.camera.to_camera(result.joints[:1]))[0]
    status, reason = names_of(result.status), result.reason
    ended = ("successful", "nonlinear_max_steps_reached")
    if status in ended and photograph.is_too_wide(one.camera, one.size):
        status, reason = "outside_focal_length", RESULTS[RESULTS.outside_focal_length]
    return Fitted(
        given=one,
        pose=np.asarray(result.pose),
        shape=np.asarray(result.shape),
        translation=np.asarray(result.translation),
        vertices=vertices,
        keypoints=np.asarray(result.keypoints),
        distance=float(root[2]),
        terms={name: float(value) for name, value in result.terms.items()},
        status=status,
        reason=reason,
        steps=int(result.steps),
        seconds=seconds,
        overlap=overlap,
    )


def people_table(people: Sequence[Fitted]) -> "Table":
    """The table that people read: one row a person."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(header_style="bold", padding=0, collapse_padding=True)
    # Where it is narrow the name folds, and what is cut is on the right: never the status.
    table.add_column("person", overflow="fold", min_width=_LEAST_NAME)
    words = (word for one in people for word in _short(one).split())
    width = max((len(word) for word in words), default=0)
    table.add_column("status", overflow="fold", min_width=width)
    headings = ("points\nseen", "error, px\nmedian", "\nlargest", "distance\nm", "overlap\ncm³")
    for heading in (*headings, "pairs"):
        table.add_column(heading, justify="right", no_wrap=True)
    for one in people:
        if one.overlap is None:
            table.add_row(escape(one.name), f"[red]{_short(one)}[/red]", str(len(one.errors)))
            continue
        color = "green" if one.overlap.volume == 0 else "default"
        table.add_row(
            escape(one.name),
            f"[red]{_short(one)}[/red]" if one.outside else _short(one),
            str(len(one.errors)),
            f"{np.median(one.errors):.1f}",
            f"{one.errors.max():.1f}",
            f"{one.distance:.2f}",
            f"[{color}]{one.overlap.volume * _CUBIC_CENTIMETRES:.2f}[/{color}]",
            f"[{color}]{one.overlap.intersecting_pairs}[/{color}]",
        )
    return table


def _short(one: Fitted) -> str:
    return one.reason.split(":")[0]


def summary(people: Sequence[Fitted]) -> str:
    """All people in one line."""
    bodies = [one for one in people if one.overlap is not None]
    count = "1 person" if len(people) == 1 else f"{len(people)} people"
    if not bodies:
        return f"{count}: none could be fitted"
    errors = np.concatenate([one.errors for one in bodies])
    overlap = sum(one.overlap.volume for one in bodies if one.overlap) * _CUBIC_CENTIMETRES
    seconds = np.mean([one.seconds for one in bodies])
    return (
        f"{count}: points {np.median(errors):.1f} pixels off (median), {overlap:.2f} cm³ of "
        f"overlap in all, {seconds:.1f} s each, compiling included"
    )


def scene_lines(scenes: Sequence[dict[str, Any]]) -> list[str]:
    """What became of people in each other, a line a scene."""
    return [
        f"{scene['image']}: {len(scene['people'])} people together, between them "
        f"{scene['before']['volume_between'] * _CUBIC_CENTIMETRES:.2f} -> "
        f"{scene['after']['volume_between'] * _CUBIC_CENTIMETRES:.2f} cm³, "
        f"{scene['before']['intersecting_pairs_between']} -> "
        f"{scene['after']['intersecting_pairs_between']} intersecting pairs"
        for scene in scenes
    ]


def as_report(
    people: Sequence[Fitted], scenes: Sequence[dict[str, Any]], settings: dict[str, Any]
) -> dict[str, Any]:
    """What report.json holds."""
    return {
        "command": "fit",
        "versions": versions(),
        "settings": settings,
        "units": {"length": "m", "image": "px", "volume": "m^3", "time": "s", "angle": "rad"},
        "people": [_person_report(one) for one in people],
        "scenes": list(scenes),
    }


def _person_report(one: Fitted) -> dict[str, Any]:
    person, camera = one.given.person, one.given.camera
    errors = one.errors
    return {
        "name": one.name,
        "image": person.image,
        "id": person.id,
        "layout": person.layout,
        "image_size": list(one.given.size),
        "camera": {
            "source": one.given.camera_source,
            "focal": np.asarray(camera.focal, np.float64).tolist(),
            "center": np.asarray(camera.center, np.float64).tolist(),
            "rotation": np.asarray(camera.rotation, np.float64).tolist(),
            "translation": np.asarray(camera.translation, np.float64).tolist(),
        },
        "status": one.status,
        "reason": one.reason,
        "points_seen": len(errors),
        "reprojection_error": {
            "mean": _number(errors.mean()),
            "median": _number(np.median(errors)),
            "largest": _number(errors.max()),
        },
        "distance": _number(one.distance),
        "terms": {name: _number(value) for name, value in one.terms.items()},
        "intersection": None if one.overlap is None else one.overlap.as_dict(),
        "steps": one.steps,
        "seconds": round(one.seconds, 3),
    }


def _number(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def write_bodies(
    folder: Path, people: Sequence[Fitted], body: "BodyModel", with_shape: bool
) -> list[str]:
    """Write poses.npz and a .glb a person; return the meshes' names.

    The poses are in the world of the camera. A camera without a rotation has y down; the meshes are
    turned then, so that viewers show them upright: y up, the camera looking along -z, as in glTF.
    """
    from spt_jax.io.mesh_files import write_mesh
    from spt_jax.io.pose_files import write_poses

    names = []
    bodies = [one for one in people if one.overlap is not None]
    for one in bodies:
        turned = np.allclose(one.given.camera.rotation, np.eye(3), atol=1e-6)
        vertices = one.vertices * ([1.0, -1.0, -1.0] if turned else 1.0)
        names.append(f"{one.name.replace('/', '_')}.glb")
        labels = None if one.overlap is None else one.overlap.labels
        write_mesh(folder / names[-1], vertices, np.asarray(body.faces), labels)
    if bodies:
        write_poses(
            folder / "poses.npz",
            np.stack([one.pose for one in bodies]),
            shape=np.stack([one.shape for one in bodies]) if with_shape else None,
            translation=np.stack([one.translation for one in bodies]),
            names=[one.name for one in bodies],
        )
    return names


def write_motions(
    folder: Path,
    people: Sequence[Fitted],
    tracks: dict[str, int],
    with_shape: bool,
    frames_per_second: float,
) -> list[str]:
    """Write a motion a track, of the frames in which there is a body; return the files' names."""
    from spt_jax.io.pose_files import write_poses

    names = []
    for number in sorted(set(tracks.values())):
        bodies = [one for one in people if tracks.get(one.name) == number and one.usable]
        if not bodies:
            continue
        names.append(f"track_{number}.npz")
        write_poses(
            folder / names[-1],
            np.stack([one.pose for one in bodies]),
            shape=bodies[0].shape if with_shape else None,
            translation=np.stack([one.translation for one in bodies]),
            names=[one.given.image for one in bodies],
            frame_rate=frames_per_second,
        )
    return names


def draw(folder: Path, people: Sequence[Fitted], faces: Any) -> tuple[list[str], str | None]:
    """Draw the bodies of each image over it; the pictures' names, or why there are none."""
    from spt_jax.show import render_overlay

    names = []
    for image in dict.fromkeys(one.given.image for one in people):
        there = [one for one in people if one.given.image == image]
        first = there[0].given
        bodies = [one for one in there if one.usable]
        canvas, shrink = first.photograph, 1.0
        if canvas is None:
            shrink = min(1.0, _LARGEST_CANVAS / max(first.size))
            width, height = (max(round(shrink * side), 16) for side in first.size)
            canvas = (width, height)
        try:
            render_overlay(
                canvas,
                [one.vertices for one in bodies],
                faces,
                _scaled(first.camera, shrink),
                [one.given.person.points * shrink for one in there],
                [one.given.person.confidence for one in there],
                [one.keypoints * shrink for one in there],
                skeleton=[one.given.person.layout for one in there],
                path=folder / f"{image}.png",
            )
        except ImportError as error:
            return names, " ".join(str(error).split())
        names.append(f"{image}.png")
    return names, None
