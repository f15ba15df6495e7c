"""Keypoint files of a folder, and the bodies of their people."""

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spt_jax.datasets.arguments import as_body_key, as_fold_distance_given
from spt_jax.datasets.figures import file_figures, overlap_figures
from spt_jax.datasets.items.work import Report, UnknownFileError
from spt_jax.datasets.runs import run
from spt_jax.datasets.summary import Summary
from spt_jax.keypoints.mistakes import Robust, robust_scale

if TYPE_CHECKING:
    from spt_jax._camera import PinholeCamera
    from spt_jax.body import BodyModel
    from spt_jax.fit.result import FitResult
    from spt_jax.keypoints import KeypointFile
    from spt_jax.keypoints.entries import Person


@dataclass
class FitKeypoints:
    """The people of each file fitted one by one, and their poses written.

    Attributes:
        layout: of keypoints, where files do not say it.
        camera: of all files; None for one that spans 55 degrees over the image's longer side.
        body: "anny", or the path of a body model.
        regularizer, fold_distance, robust, fit_shape: as in `spt-jax fit`.
        max_bytes: what a file may take.
    """

    layout: str | None = None
    camera: "PinholeCamera | None" = None
    body: str = "anny"
    regularizer: str = "spt"
    fold_distance: float | None = None
    robust: Robust = "auto"
    fit_shape: bool = False
    max_bytes: int | None = None
    name: str = field(default="fit", init=False)

    def settings(self) -> dict[str, Any]:
        """All that a result depends on."""
        own = ("layout", "regularizer", "fold_distance", "robust", "fit_shape")
        camera = None
        if self.camera is not None:
            parts = ("focal", "center", "rotation", "translation", "near")
            camera = {part: np.asarray(getattr(self.camera, part)).tolist() for part in parts}
        known = {key: getattr(self, key) for key in own}
        return {"body": as_body_key(self.body), "camera": camera, **known}

    def wants(self, path: Path) -> bool:
        """Whether the suffix is one of keypoint files."""
        return path.suffix.lower() in (".json", ".npz")

    def start(self) -> None:
        """Load the body, and prepare what keeps it from passing through itself."""
        from spt_jax._exclusions import as_fold_surface
        from spt_jax.body import load_body
        from spt_jax.fit import SelfIntersection, as_regularizer
        from spt_jax.io.pose_files import check_joints

        self.body_model: BodyModel = load_body(self.body, max_bytes=self.max_bytes)
        check_joints(self.body, self.body_model.num_joints)
        self.rest_surface = as_fold_surface(self.body_model, self.fold_distance)
        term = as_regularizer(self.regularizer)
        if isinstance(term, SelfIntersection):
            term = dataclasses.replace(term, fold_distance=self.fold_distance)
        self.prepared = term.prepared(self.body_model, 1)

    def work(self, path: Path, out: Path, report: Report) -> dict[str, Any]:
        """Fit a file's people, and write their poses in AMASS' layout, a row a person."""
        from spt_jax.io.pose_files import write_poses

        file = self._opened(path)
        found: list[tuple[str, FitResult]] = []
        people = []
        for number, person in enumerate(file.people):
            name = f"{path.stem if person.image is None else person.image}/{number}"
            report(number, len(file.people), name)
            result, figures = self._fitted(file, person)
            people.append({"person": name, "frames": 1, "worst_frame": 0, **figures})
            if np.isfinite(np.asarray(result.vertices)).all():
                found.append((name, result))
        notes = list(file.notes)
        notes += [f"left out: {count} people with {why}" for why, count in file.skipped.items()]
        if self.camera is None and people:
            notes.append("the camera is not known; one that spans 55 degrees is taken")
        if found:
            results = [result for _, result in found]
            stem = path.stem if path.suffix.lower() == ".npz" else path.name
            write_poses(
                out / f"{stem}.npz",
                np.stack([np.asarray(one.pose) for one in results]),
                shape=np.stack([np.asarray(one.shape) for one in results])
                if self.fit_shape
                else None,
                translation=np.stack([np.asarray(one.translation) for one in results]),
                names=[name for name, _ in found],
            )
        worst = max(people, key=lambda one: one.get("largest_depth", 0.0), default=None)
        return {
            **(file_figures(people) if people else {"people_count": 0, "frames": 0}),
            "converged": sum(one["status"] == "successful" for one in people),
            "worst_person": worst["person"] if worst else "",
            "worst_frame": 0,
            "notes": notes,
            "people": people,
        }

    def draw(self, *_: Any) -> str:
        """Why the report has no pictures."""
        return "spt-jax fit FILE draws the people of a file over their image"

    def _opened(self, path: Path) -> "KeypointFile":
        from spt_jax.io.pose_files import open_poses
        from spt_jax.keypoints import read_keypoints

        try:
            return read_keypoints(path, layout=self.layout, max_bytes=self.max_bytes)
        except ValueError as error:
            try:
                file = open_poses(path, max_bytes=self.max_bytes)
            except (ValueError, OSError):
                raise error from None
            raise UnknownFileError(
                f"keypoint file must hold keypoints: got {str(path)!r} with poses in the structure "
                f"of {file.structure}, which spt-jax clean takes."
            ) from error

    def _fitted(self, file: "KeypointFile", person: "Person") -> tuple["FitResult", dict[str, Any]]:
        from spt_jax._status import names_of
        from spt_jax.fit import Start, Terms, fit_pose
        from spt_jax.metrics import motion_overlap
        from spt_jax.overlap.measure import Unmeasurable

        same = [one for one in file.people if one.image == person.image]
        result = fit_pose(
            self.body_model,
            person.points.astype(np.float32),
            self.camera or _camera_of(same),
            layout=person.layout,
            confidence=person.confidence.astype(np.float32),
            start=Start(fit_shape=self.fit_shape),
            terms=Terms(robust=robust_scale(person, self.robust)),
            regularizer=self.prepared,
        )
        seen = person.confidence > 0
        off = np.linalg.norm(np.asarray(result.keypoints) - person.points, axis=1)[seen]
        figures: dict[str, Any] = {
            "status": names_of(result.status),
            "reason": result.reason,
            "points_seen": int(seen.sum()),
        }
        vertices = np.asarray(result.vertices)
        if np.isfinite(vertices).all():
            figures |= {
                "mean_pixels_off": float(off.mean()),
                "largest_pixels_off": float(off.max()),
            }
            try:
                overlap = motion_overlap(
                    vertices[None], self.body_model.faces, rest_surface=self.rest_surface
                )
                figures |= overlap_figures(overlap)
            except Unmeasurable:
                pass
        return result, figures


def _camera_of(people: Sequence["Person"]) -> "PinholeCamera":
    """One that spans 55 degrees over the longer side of the image of some people."""
    from spt_jax._camera import PinholeCamera
    from spt_jax.keypoints.image_size import guessed_image_size, stated_image_size

    width, height = stated_image_size(people) or guessed_image_size(people)
    return PinholeCamera.from_field_of_view(float(width), float(height))


def fit(
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    layout: str | None = None,
    camera: "PinholeCamera | None" = None,
    body: str = "anny",
    regularizer: str = "spt",
    fold_distance: float | None = None,
    robust: Robust = "auto",
    fit_shape: bool = False,
    max_bytes: int | None = None,
    **how: Any,
) -> Summary:
    """Fit a body to every person of every keypoint file of a folder.

    Each file that `read_keypoints` reads becomes an .npz in AMASS' layout, a row a person, in the
    world of the camera. People are fitted one by one, so that programs are compiled once a layout.

    Args:
        folder: the data set; folders in it are looked through too.
        out: where results go, made where missing, as `clean` has it.
        layout: of the keypoints, where files do not say it.
        camera: of all files; None for one that spans 55 degrees over each image's longer side.
        body: "anny", or the path of a body model.
        regularizer: as in `fit_pose`, by name.
        fold_distance: as in `untangle_pose`.
        robust: how far off, in pixels, a keypoint is half taken for a mistake; "auto" is a tenth of
            the larger side of the box around the person's keypoints; "off" trusts them all.
        fit_shape: whether to fit the body's shape, too.
        max_bytes: what a file and its arrays may take.
        how: as in `run`: engine, processes, shard, anew, retry, verify, ray, on_event.

    Returns:
        The summary, as in summary.json; its frames are people.

    Raises:
        As `run`.

    Example:
        >>> import json, pathlib, tempfile
        >>> from spt_jax.datasets import fit
        >>> with tempfile.TemporaryDirectory() as top:
        ...     folder = pathlib.Path(top, "in")
        ...     folder.mkdir()
        ...     _ = (folder / "empty.json").write_text(json.dumps({"people": [], "version": 1.3}))
        ...     found = fit(folder, pathlib.Path(top, "out"), processes=0)
        >>> found.files
        1
    """
    if robust not in ("auto", "off") and not 0 < float(robust) < np.inf:
        raise ValueError(f'robust must be a positive number, "auto" or "off": got {robust!r}.')
    task = FitKeypoints(
        layout=layout,
        camera=camera,
        body=os.fspath(body),
        regularizer=regularizer,
        fold_distance=as_fold_distance_given(fold_distance),
        robust=robust,
        fit_shape=fit_shape,
        max_bytes=max_bytes,
    )
    return run(task, folder, out, **how)
