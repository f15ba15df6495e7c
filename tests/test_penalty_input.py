"""Wrong input: what fails when traced, and what comes back as NaN."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers import box, embedded_body
from helpers_penalty import FACES, PAIR, as_jax, loss

from spt_jax import RestSurface, classify_vertices, intersection_report, self_intersection_penalty
from spt_jax.overlap.triangles import near_triangles
from spt_jax.xla.settings import Xla

OPTIONS = {
    "default": {},
    "margin": {"margin": 0.1},
    "groups": {"face_groups": np.repeat([0, 1], len(FACES) // 2), "ignore_groups": ((0, 0),)},
    "rest_surface": {"rest_surface": RestSurface(*PAIR)},
    "ratio": {"value": "ratio", "rule": "triangle", "gradient": "unit"},
    "rays": {"rays": (20, 30), "directions": 1},
}


@pytest.mark.parametrize("name", OPTIONS)
def test_nan_and_nothing_with_every_option(name):
    """One vertex that is not finite: NaN without a gradient. No triangles, or no vertices: zero."""
    options = OPTIONS[name]

    def penalty(vertices, faces=FACES):
        return self_intersection_penalty(vertices, faces, **options)

    value, gradient = jax.value_and_grad(penalty)(as_jax(PAIR, "float32").at[5, 1].set(np.nan))
    assert np.isnan(value)
    np.testing.assert_array_equal(gradient, 0.0)
    apart = as_jax(PAIR, "float32").at[len(PAIR[0]) // 2 :, 0].add(3.0)
    value, gradient = jax.value_and_grad(penalty)(apart)
    assert value == 0 and np.abs(gradient).max() == 0
    none = np.zeros((0, 3), np.int32)
    for name in ("face_groups", "ignore_groups", "rest_surface"):
        options = {key: value for key, value in options.items() if key != name}
    for count in (0, 4):
        value, gradient = jax.value_and_grad(penalty)(jnp.ones((count, 3)), none)
        assert value == 0 and gradient.shape == (count, 3) and not gradient.any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_vertices_that_are_not_finite_give_nan_and_no_gradient(dtype, bad):
    vertices = as_jax(PAIR, dtype).at[5, 1].set(bad)
    for run in (jax.value_and_grad(loss), jax.jit(jax.value_and_grad(loss))):
        value, gradient = run(vertices)
        assert np.isnan(value)
        np.testing.assert_array_equal(gradient, 0.0)
    # The rest of a batch is not touched.
    batch = jnp.stack([as_jax(PAIR, dtype), vertices])
    values, gradients = jax.vmap(jax.value_and_grad(loss))(batch)
    assert values[0] == loss(batch[0]) and np.isnan(values[1])
    assert np.abs(gradients[0]).max() > 0 and np.abs(gradients[1]).max() == 0


def test_traced_faces_out_of_range_give_nan():
    wrong = jnp.asarray(FACES).at[3, 1].set(len(PAIR[0]))
    value, gradient = jax.jit(jax.value_and_grad(loss))(as_jax(PAIR, "float32"), wrong)
    assert np.isnan(value) and np.abs(gradient).max() == 0


def _wrong(**options):
    return lambda: self_intersection_penalty(jnp.asarray(PAIR[0], "float32"), FACES, **options)


def _ignoring(pairs):
    return _wrong(face_groups=np.repeat([0, 1], len(FACES) // 2), ignore_groups=pairs)


def _wrong_mesh(vertices, faces=FACES):
    return lambda: self_intersection_penalty(vertices, faces)


GOOD = jnp.asarray(PAIR[0], "float32")
ERRORS = {
    "vertices shape": (_wrong_mesh(GOOD[:, :2]), ValueError, "vertices must have shape"),
    "vertices rank": (_wrong_mesh(GOOD[0]), ValueError, r"vertices must have shape .*got \(3,\)"),
    "vertices dtype": (_wrong_mesh(jnp.ones((4, 3), "int32")), TypeError, "got int32"),
    "vertices half": (_wrong_mesh(GOOD.astype("float16")), TypeError, "got float16"),
    "faces shape": (_wrong_mesh(GOOD, FACES[:, :2]), ValueError, "faces must have shape"),
    "faces rank": (_wrong_mesh(GOOD, FACES[0]), ValueError, r"faces must have shape .*\(3,\)"),
    "faces dtype": (_wrong_mesh(GOOD, FACES * 1.0), TypeError, "faces must be whole numbers"),
    "face too large": (
        _wrong_mesh(GOOD, np.where(FACES == 7, len(GOOD), FACES)),
        ValueError,
        f"got index {len(GOOD)} for {len(GOOD)} vertices; indices are 0-based",
    ),
    "face negative": (_wrong_mesh(GOOD, FACES - 1), ValueError, "got index -1"),
    "no rays": (_wrong(rays=0), ValueError, "rays must be from 1 to .*got 0"),
    "far too many rays": (_wrong(rays=5000), ValueError, "from 1 to 4096 a side: got 5000"),
    "negative rays": (_wrong(rays=(3, -4)), ValueError, r"got \(3, -4\)"),
    "fractional rays": (_wrong(rays=3.5), TypeError, "whole number"),
    "misspelt rays": (_wrong(rays="automatic"), TypeError, "rays must be None, a whole"),
    "value": (_wrong(value="area"), ValueError, "value must be one of 'volume', 'ratio'"),
    "gradient": (_wrong(gradient="exact"), ValueError, "gradient must be one of 'boundary'"),
    "two directions": (_wrong(directions=2), ValueError, "directions must be 1, 3 or an array"),
    "zero direction": (_wrong(directions=[[0, 0, 0]]), ValueError, "finite and not zero.*row 0"),
    "nan direction": (
        _wrong(directions=[[0, 0, 1], [np.nan, 0, 1]]), ValueError, "not zero.*row 1"
    ),
    "flat direction": (_wrong(directions=[0, 0, 1]), ValueError, r"got shape \(3,\)"),
    "named direction": (_wrong(directions="up"), TypeError, "got 'up'"),
    "backend": (_wrong(backend="cuda"), ValueError, "backend must be one of"),
    "device size": (_wrong(backend=Xla(sorted=0)), ValueError, "sorted must be a positive whole"),
    "negative margin": (_wrong(margin=-0.01), ValueError, "margin must be finite and.*got -0.01"),
    "endless margin": (_wrong(margin=np.inf), ValueError, "margin must be finite"),
    "nan margin": (_wrong(margin=np.float32("nan")), ValueError, "margin must be finite"),
    "margin a string": (_wrong(margin="0.01"), TypeError, "number known when traced: got '0.01'"),
    "margin a bool": (_wrong(margin=True), TypeError, "number known when traced"),
    "margin an array": (_wrong(margin=jnp.ones(())), TypeError, "number known when traced"),
    "groups that are no numbers": (_wrong(face_groups=np.zeros(3)), TypeError, "got float64"),
    "a group a vertex": (
        _wrong(face_groups=np.zeros(len(GOOD), int)), ValueError, "one number a face, .640,"
    ),
    "ignored alone": (_wrong(ignore_groups=((0, 1),)), ValueError, "must come with face_groups"),
    "no pairs": (_ignoring((0, 1)), ValueError, r"must be pairs of group numbers.*got \(0, 1\)"),
    "no whole pairs": (_ignoring(((0, 0.5),)), ValueError, "must be pairs of group numbers"),
    "uneven pairs": (_ignoring(((0, 1), (1,))), ValueError, "must be pairs of group numbers"),
    "pairs a number": (_ignoring(3), ValueError, "must be pairs of group numbers.*got 3"),
    "no such group": (_ignoring(((0, 7),)), ValueError, r"got \(0, 7\), and no face is in group 7"),
    "rest_surface": (
        _wrong(rest_surface=object()), TypeError, "must be a RestSurface or None: got object"
    ),
    "rest_surface of another mesh": (
        _wrong(rest_surface=RestSurface(*box())), ValueError, "got one of 12 faces for 640.*copies"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ERRORS)
def test_wrong_input_fails_when_traced(name, untyped):
    call, kind, message = ERRORS[name]
    with pytest.raises(kind, match=message):
        call()
    with pytest.raises(kind, match=message):
        jax.eval_shape(call)


@pytest.mark.parametrize("function", [classify_vertices, intersection_report])
def test_labels_and_report_refuse_the_same(function, untyped):
    groups = np.repeat([0, 1], len(FACES) // 2)
    with pytest.raises(ValueError, match="must come with face_groups"):
        function(GOOD, FACES, ignore_groups=((0, 1),))
    with pytest.raises(ValueError, match="no face is in group 2"):
        function(GOOD, FACES, face_groups=groups, ignore_groups=((0, 2),))
    with pytest.raises(TypeError, match="rest_surface must be a RestSurface"):
        function(GOOD, FACES, rest_surface=True)


def test_traced_groups_are_refused(untyped):
    call = jax.jit(lambda g: self_intersection_penalty(GOOD, FACES, face_groups=g))
    with pytest.raises(TypeError, match="face_groups must be known when traced"):
        call(jnp.zeros(len(FACES), "int32"))


def test_traced_directions_are_refused(untyped):
    with pytest.raises(TypeError, match="directions must be known when traced"):
        jax.jit(lambda d: self_intersection_penalty(GOOD, FACES, directions=d))(jnp.eye(3))


def test_directions_scale_and_type_do_not_matter():
    one = self_intersection_penalty(GOOD, FACES, rays=32, directions=[[0, 0, -2.5]])
    assert one == self_intersection_penalty(GOOD, FACES, rays=32, directions=1)
    assert one == self_intersection_penalty(GOOD, FACES, rays=32, directions=[[0, 0, -1e-200]])
    three = self_intersection_penalty(GOOD, FACES, rays=32, directions=jnp.eye(3))
    assert three == pytest.approx(float(one), rel=0.05)


@pytest.mark.parametrize("rays", [None, 32])
def test_a_mesh_that_rounding_has_eaten_is_nan_and_a_point_is_free(dtype, rays):
    """What a solver that was thrown off course hands over; it took all memory once."""
    body = embedded_body()
    home = np.asarray(body.template, dtype)
    away = np.array([[3e5 if dtype == np.float32 else 3e14, 0.0, 0.0]], dtype)

    def both(vertices):
        def loss(v):
            return self_intersection_penalty(v, body.faces, rays=rays)

        value, gradient = jax.value_and_grad(loss)(jnp.asarray(vertices, dtype))
        assert np.abs(gradient).max() == 0
        return value

    assert np.isnan(both(home + away))
    assert both(np.zeros_like(home) + away) == 0


def test_a_crumpled_mesh_is_nan_and_the_report_says_why(monkeypatch, rng):
    monkeypatch.setattr(near_triangles, "_MOST_PAIRS", 1000)
    monkeypatch.setattr(near_triangles, "_MOST_PAIRS_EACH", 0)
    faces = trimesh.creation.icosphere(3).faces
    vertices = rng.normal(size=(faces.max() + 1, 3))
    crumpled = jnp.asarray(vertices, jnp.float32)
    value, gradient = jax.value_and_grad(lambda v: self_intersection_penalty(v, faces))(crumpled)
    assert np.isnan(value) and not np.asarray(gradient).any()
    assert not np.asarray(classify_vertices(crumpled, faces).labels).any()
    with pytest.raises(ValueError, match=r"vertices must be a surface .* more than 1,000 pairs of"):
        intersection_report(vertices, faces)
