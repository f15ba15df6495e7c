"""Frames and people as arrays that a run keeps, and back, to the bit."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from spt_jax._report import IntersectionReport
from spt_jax.overlap.caps import Hole

if TYPE_CHECKING:
    from spt_jax.cli.annotated import Annotated
    from spt_jax.cli.fitted import Fitted
    from spt_jax.cli.frames import Frame

_FACTS = "facts"
_WHEN = ("before", "after")
_FRAME_FACTS = ("name", "steps", "seconds", "is_free", "reason")
_PERSON_ARRAYS = ("pose", "shape", "translation", "vertices", "keypoints")
_PERSON_FACTS = ("distance", "terms", "status", "reason", "steps", "seconds")


def frame_arrays(frame: "Frame", *, vertices: bool) -> dict[str, np.ndarray]:
    """A frame as arrays; its vertices, which only its meshes need, where they are asked for."""
    facts = {name: getattr(frame, name) for name in _FRAME_FACTS}
    arrays = {"pose": frame.pose}
    if vertices:
        arrays |= {"before": frame.vertices_before, "after": frame.vertices_after}
    for when, report in (("before", frame.before), ("after", frame.after)):
        facts[when] = _report_facts(report)
        arrays[f"labels {when}"] = report.labels
    return arrays | {_FACTS: _as_text(facts)}


def frame_of(arrays: Mapping[str, np.ndarray]) -> "Frame":
    """The frame that `frame_arrays` took apart."""
    from spt_jax.cli.frames import Frame

    facts = _from_text(arrays[_FACTS])
    nothing = np.empty((0, 3), np.float32)
    reports = {when: _report(facts.pop(when), arrays[f"labels {when}"]) for when in _WHEN}
    return Frame(
        pose=arrays["pose"],
        vertices_before=arrays.get("before", nothing),
        vertices_after=arrays.get("after", nothing),
        **reports,
        **facts,
    )


def people_arrays(
    people: Sequence["Fitted"], scene: Mapping[str, Any] | None
) -> dict[str, np.ndarray]:
    """People fitted together, or one, and what the report says of their scene, as arrays."""
    arrays, facts = {}, []
    for k, one in enumerate(people):
        arrays |= {f"{name} {k}": getattr(one, name) for name in _PERSON_ARRAYS}
        own = {name: getattr(one, name) for name in _PERSON_FACTS}
        if one.overlap is not None:
            own["overlap"] = _report_facts(one.overlap)
            arrays[f"labels {k}"] = one.overlap.labels
        facts.append(own)
    return arrays | {_FACTS: _as_text({"people": facts, "scene": scene})}


def people_of(
    arrays: Mapping[str, np.ndarray], given: Sequence["Annotated"]
) -> tuple[list["Fitted"], dict[str, Any] | None]:
    """The people, of those that were given, and the scene that `people_arrays` took apart."""
    from spt_jax.cli.fitted import Fitted

    facts = _from_text(arrays[_FACTS])
    people = []
    for k, (one, own) in enumerate(zip(given, facts["people"], strict=True)):
        overlap = own.pop("overlap", None)
        overlap = None if overlap is None else _report(overlap, arrays[f"labels {k}"])
        own |= {name: arrays[f"{name} {k}"] for name in _PERSON_ARRAYS}
        people.append(Fitted(given=one, overlap=overlap, **own))
    return people, facts["scene"]


def _report_facts(report: IntersectionReport) -> dict[str, Any]:
    return {f.name: getattr(report, f.name) for f in fields(report) if f.name != "labels"}


def _report(facts: Mapping[str, Any], labels: np.ndarray) -> IntersectionReport:
    values = {name: _as_tuples(value) for name, value in facts.items()}
    holes = tuple(Hole(*hole) for hole in values.pop("holes"))
    return IntersectionReport(labels=labels, holes=holes, **values)


def _as_tuples(value: Any) -> Any:
    return tuple(map(_as_tuples, value)) if isinstance(value, list) else value


def _as_text(facts: Mapping[str, Any]) -> np.ndarray:
    # Python writes a float so that the same is read.
    return np.array(json.dumps(facts, default=lambda value: np.asarray(value).tolist()))


def _from_text(text: np.ndarray) -> dict[str, Any]:
    return json.loads(text.item())
