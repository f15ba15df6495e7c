"""What can be added is added in one place, and what is listed twice is the same in both."""

import inspect
import typing

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import box, embedded_body, join, sampling

from spt_jax import fit as public
from spt_jax import intersection_report, keypoint_regressor, self_intersection_penalty
from spt_jax._query import as_criterion
from spt_jax.cli import main
from spt_jax.cli.fit import fit
from spt_jax.fit import Regularizer, SelfIntersection, as_regularizer, regularizer_names
from spt_jax.io.mesh_files import read_mesh
from spt_jax.io.meshes import reading
from spt_jax.io.meshes.raw import RawMesh
from spt_jax.keypoints.layouts import LAYOUTS, Layout
from spt_jax.overlap.criteria import CRITERIA, Criterion, Value
from spt_jax.overlap.exclusions import NOTHING
from spt_jax.overlap.host_functions import PenaltyOptions, value_and_gradient_on_host


def choices(function, name):
    """The strings that an argument may be."""
    annotation = inspect.signature(function).parameters[name].annotation
    members = (annotation, *typing.get_args(annotation))
    literals = [m for m in members if typing.get_origin(m) is typing.Literal]
    return {choice for literal in literals for choice in typing.get_args(literal)}


def test_regularizers_have_the_same_names_everywhere():
    names = regularizer_names()
    assert choices(fit, "regularizer") == set(names)
    found = {type(as_regularizer(name)) for name in names}
    assert [as_regularizer(name).name for name in names] == list(names)
    exported = {getattr(public, name) for name in public.__all__}
    kinds = {kind for kind in exported if isinstance(kind, type) and issubclass(kind, Regularizer)}
    assert found == kinds - {Regularizer}


def test_criteria_have_the_same_names_everywhere():
    known = set(typing.get_args(Value))
    assert set(CRITERIA) == known
    assert choices(self_intersection_penalty, "value") == known
    assert choices(SelfIntersection, "value") == known


def test_one_entry_makes_a_criterion(monkeypatch):
    """From the argument's check to the host; types of arguments are strict in tests."""
    vertices, faces = join(box(), box(center=(0.6, 0.3, 0.2)))
    with pytest.raises(ValueError, match="value must be one of 'volume', 'ratio': got 'pairs'"):
        as_criterion("pairs", on_device=False)
    pairs = Criterion(lambda found, _: found.intersecting_pairs, slope=lambda found: found.vertices)
    monkeypatch.setitem(CRITERIA, "pairs", pairs)
    name = as_criterion("pairs", on_device=False)
    options = PenaltyOptions(name, "boundary", "vertex", sampling(None), NOTHING, 1e-7)
    value, slope = value_and_gradient_on_host(vertices, faces, options)
    assert value == intersection_report(vertices, faces).intersecting_pairs > 0
    np.testing.assert_array_equal(slope, vertices)
    with pytest.raises(ValueError, match=r"'ratio' with backend=\"xla\": got 'pairs'"):
        as_criterion("pairs", on_device=True)


def test_one_entry_makes_a_command(monkeypatch, capsys):
    def greet(name: str = "world") -> int:
        """Say hello."""
        print(f"hello {name}")
        return 0

    monkeypatch.setitem(main._COMMANDS, "greet", greet)
    assert main.main(["greet", "--name", "you"]) == 0
    assert capsys.readouterr().out == "hello you\n"


def test_one_entry_makes_a_mesh_format(monkeypatch, tmp_path):
    def read_tri(content: bytes, *_) -> RawMesh:
        rows = [line.split() for line in content.decode().splitlines()]
        vertices = np.array([row[1:] for row in rows if row[0] == "v"], float)
        return RawMesh(vertices, np.array([row[1:] for row in rows if row[0] == "t"], int))

    readers = reading._readers()
    monkeypatch.setattr(reading, "_readers", lambda: readers | {".tri": read_tri})
    path = tmp_path / "tetrahedron.tri"
    corners = ("0 0 0", "1 0 0", "0 1 0", "0 0 1")
    sides = ("0 2 1", "0 1 3", "1 2 3", "0 3 2")
    path.write_text("".join([*(f"v {x}\n" for x in corners), *(f"t {x}\n" for x in sides)]))
    assert read_mesh(path)[1].shape == (4, 3)
    assert main.main(["check", str(path), "--quiet"]) in (0, 1)


def test_one_entry_makes_a_layout(monkeypatch):
    names = ("head", "left_wrist", "right_wrist", "pelvis")
    with pytest.raises(ValueError, match=r"coco17.*: got 'four'"):
        keypoint_regressor(embedded_body(), "four")
    monkeypatch.setitem(LAYOUTS, "four", Layout("four", names, names, ((1, 0), (0, 2)), names))
    regressor = keypoint_regressor(embedded_body(), "four")
    by_name = keypoint_regressor(embedded_body(), names)
    posed = embedded_body()(jnp.zeros((embedded_body().num_joints, 3)))
    np.testing.assert_array_equal(regressor.of(posed), by_name.of(posed))
