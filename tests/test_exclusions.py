"""What does not count: groups left out, and folds told from collisions by a rest surface."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    bent_tube,
    body_faces,
    boolean_overlap,
    box,
    embedded_body,
    join,
    moved,
    posed_bodies,
    random_rotation,
    sampling,
    sphere,
)

from spt_jax import (
    RestSurface,
    between_groups,
    classify_vertices,
    intersection_report,
    join_bodies,
    self_intersection_penalty,
    within_groups,
)
from spt_jax._exclusions import as_exclusions
from spt_jax.overlap.measure import measure

# Three balls in a row: the first two overlap, and the last two.
BALLS = [
    moved(sphere(0.7, subdivisions=2), random_rotation(np.random.default_rng(k)), (x, 0.01 * k, 0))
    for k, x in enumerate((0.0, 1.2, 2.3))
]
ROW = join(*BALLS)
GROUPS = np.repeat([4, 0, 9], len(BALLS[0][1]))  # any numbers will do


def measured(mesh, rest_surface=None, groups=None, ignored=(), rays=None):
    exclusions = as_exclusions(groups, ignored, rest_surface, mesh[1])
    return measure(*mesh, sampling(rays), exclusions)


@pytest.mark.parametrize("rays", [None, 256])
def test_groups_of_three_balls(rays):
    left, right = boolean_overlap(*BALLS[:2]), boolean_overlap(*BALLS[1:])
    close = {"rel": 1e-9 if rays is None else 0.01}
    row = functools.partial(measured, ROW, groups=GROUPS, rays=rays)
    assert row(ignored=()).volume == pytest.approx(left + right, **close)
    assert row(ignored=((4, 9),)).volume == pytest.approx(left + right, **close)
    for pair, rest, free in (((4, 0), right, 0), ((9, 0), left, 2)):
        found = row(ignored=(pair,))
        assert found.volume == row(ignored=(pair[::-1], pair)).volume
        assert found.volume == pytest.approx(rest, **close)
        assert found.total_volume == pytest.approx(left + right, **close)
        pull = found.gradient("boundary", "vertex").reshape(3, -1, 3)
        assert not pull[free].any() and pull[1].any()
        labels = found.labels("vertex").reshape(3, -1)
        assert not labels[free].any() and labels[1].any()
    nothing = row(ignored=((4, 0), (0, 9)))
    assert nothing.volume == 0 and not nothing.gradient("boundary", "vertex").any()
    assert not nothing.labels("vertex").any() and not nothing.labels("triangle").any()
    # An overlap of a ball with another is none within a group.
    assert row(ignored=((4, 4), (0, 0), (9, 9))).volume == row(ignored=()).volume


def test_two_people(x64):
    """Between and within make up the whole, and within is what each has alone."""
    turn = np.diag([-1.0, -1.0, 1.0])
    first, second = posed_bodies(["crawl/0092", "run/0005"])
    scene = join_bodies(np.stack([first, second @ turn + (0.1, 0.25, -0.1)]), body_faces())
    mesh = np.asarray(scene.vertices, np.float64), np.asarray(scene.faces, np.int64)
    groups = np.asarray(scene.face_groups)
    whole = measured(mesh).volume
    between = measured(mesh, groups=groups, ignored=within_groups(2)).volume
    within = measured(mesh, groups=groups, ignored=between_groups(2)).volume
    alone = sum(measured((body, body_faces())).volume for body in (first, second))
    assert between > 1e-4 and alone > 1e-4
    assert between + within == pytest.approx(whole, rel=1e-12)
    assert within == pytest.approx(alone, rel=1e-12)
    # Copies of a rest surface fold each by itself; what two people share is never a fold.
    rest = embedded_body().rest_surface
    folded = measured(mesh, rest_surface=rest.copies(2)).volume
    each = sum(measured((body, body_faces()), rest).volume for body in (first, second))
    assert folded == pytest.approx(between + each, rel=1e-12) and folded < whole


def straight(mesh, turns, bend):
    """The tube of `bent_tube` before it was bent."""
    vertices, faces = mesh
    sides = (len(vertices) - 2) // len(turns)
    around = np.append(np.repeat(turns, sides), turns[[0, -1]])
    out = np.hypot(vertices[:, 0], vertices[:, 1])
    inner = np.cos(around) * vertices[:, 0] + np.sin(around) * vertices[:, 1] < 0
    flat = np.stack([np.where(inner, -out, out) - bend, bend * around, vertices[:, 2]], axis=1)
    return RestSurface(flat, faces, distance=0.5)


def tube(angle, thick, thin, bend, steps, sides=24):
    mesh = bent_tube(angle, thick, thin, bend, sides, steps)
    rest = straight(mesh, np.linspace(0, 2 * np.pi + angle, steps), bend)
    rng = np.random.default_rng(5)
    noise = 1e-3 * rng.normal(size=mesh[0].shape)  # else the two halves meet edge to edge
    return moved((mesh[0] + noise, mesh[1]), random_rotation(rng), (0.1, 0.2, 0.3)), rest


def knee():
    """A tube bent tighter than it is thick, so that its inner side is inside out."""
    return tube(3.0 - 2 * np.pi, 0.3, 0.3, 0.2, steps=5, sides=15)


def test_a_far_end_that_touches_counts():
    """A tube bent into a ring, whose end enters its beginning: 6 m along the tube are no fold."""
    ring, rest = tube(0.4, 0.3, 0.1, 1.0, 80)
    whole = measured(ring)
    assert whole.volume > 1e-3
    found = measured(ring, rest_surface=rest)
    assert found.volume == whole.volume == found.total_volume
    np.testing.assert_array_equal(found.labels("vertex"), whole.labels("vertex"))
    assert found.intersecting_pairs == whole.intersecting_pairs
    assert measured(ring, rest_surface=rest.within(100.0)).volume == 0


def test_a_fold_does_not_count():
    mesh, rest = knee()  # 0.6 long
    whole = measured(mesh)
    assert whole.volume > 1e-3 and whole.labels("vertex").any()
    found = measured(mesh, rest_surface=rest.within(1.0))
    assert found.volume == 0 and found.total_volume == pytest.approx(whole.volume, rel=1e-12)
    assert not found.labels("vertex").any() and not found.gradient("boundary", "vertex").any()
    assert found.intersecting_pairs == 0 < whole.intersecting_pairs
    assert measured(mesh, rest_surface=rest.within(0.0)).volume == pytest.approx(
        whole.volume, rel=1e-12
    )


FRAMES = {"run/0005": False, "crawl/0092": False, "crawl/0012": True, "roll/0056": True}


@pytest.mark.parametrize("frame", FRAMES)
def test_penalty_labels_and_report_agree_on_bodies(frame, x64):
    """Where folds are all there is, nothing counts; elsewhere a part of the overlap."""
    vertices, faces = posed_bodies([frame])[0], body_faces()
    options = {"rest_surface": embedded_body().rest_surface}
    report = intersection_report(vertices, faces, **options)
    value = float(self_intersection_penalty(jnp.asarray(vertices), faces, **options))
    label = classify_vertices(jnp.asarray(vertices), faces, **options).labels
    assert value == report.volume
    np.testing.assert_array_equal(report.labels, label)
    whole = intersection_report(vertices, faces)
    assert report.total_volume == pytest.approx(whole.volume, rel=1e-12)
    assert report.total_intersecting_pairs == whole.intersecting_pairs > 0
    # A vertex that counts is one of the overlap.
    np.testing.assert_array_equal(np.where(report.labels != 0, whole.labels, 0), report.labels)
    if FRAMES[frame]:
        assert 0.01 * whole.volume < value < 0.5 * whole.volume
        assert (
            report.labels.any() and 0 < report.intersecting_pairs < report.total_intersecting_pairs
        )
        assert "with what is excluded" in str(report)
    else:
        assert value == 0 and not report.labels.any() and report.intersecting_pairs == 0


def test_nothing_left_out_is_the_whole(x64):
    vertices, faces = jnp.asarray(ROW[0]), ROW[1]
    whole = jax.value_and_grad(self_intersection_penalty)(vertices, faces)
    apart = join(*(moved(ball, translation=(5.0 * k, 0, 0)) for k, ball in enumerate(BALLS)))
    rest = RestSurface(*apart, distance=0.0)
    for options in (
        {"face_groups": GROUPS},
        {"face_groups": GROUPS, "ignore_groups": ((4, 9),)},
        {"rest_surface": rest},
    ):
        found = jax.value_and_grad(self_intersection_penalty)(vertices, faces, **options)
        assert float(found[0]) == pytest.approx(float(whole[0]), rel=1e-12)
        np.testing.assert_allclose(found[1], whole[1], atol=1e-12)


def differences(run, mesh, velocity, step):
    ends = [run((mesh[0] + s * velocity, mesh[1])).volume for s in (step, -step)]
    return (ends[0] - ends[1]) / (2 * step)


def test_gradient_with_folds_is_the_derivative_in_closed_form():
    rng = np.random.default_rng(1)
    mesh, rest = tube(0.4, 0.3, 0.1, 1.0, 80)
    exact = measured(mesh, rest).gradient("boundary", "vertex")
    velocity = 0.1 * rng.normal(size=exact.shape)
    numeric = differences(functools.partial(measured, rest_surface=rest), mesh, velocity, 1e-5)
    assert np.sum(exact * velocity) == pytest.approx(
        numeric, abs=1e-6 * np.abs(exact * velocity).sum()
    )
    assert abs(numeric) > 1e-6


def test_transformations_with_folds_and_groups(dtype):
    """jit, vmap and grad, in both precisions, on a batch of a ring closing on itself."""
    ring, rest = tube(0.4, 0.3, 0.1, 1.0, 40)
    other, _ = tube(0.6, 0.3, 0.1, 1.0, 40)
    groups = np.zeros(len(ring[1]), np.int32)
    batch = jnp.asarray(np.stack([ring[0], 0.5 * ring[0] + 0.5 * other[0], other[0]]), dtype)

    def loss(vertices):
        return self_intersection_penalty(
            vertices, ring[1], rest_surface=rest, face_groups=groups, ignore_groups=()
        )

    values = np.stack([loss(v) for v in batch])
    slopes = np.stack([jax.grad(loss)(v) for v in batch])
    assert values.dtype == dtype and slopes.dtype == dtype and (values > 0).all()
    close = {"rtol": 1e-5, "atol": 1e-6}
    np.testing.assert_allclose(loss(batch), values, **close)
    np.testing.assert_allclose(jax.jit(jax.vmap(loss))(batch), values, **close)
    np.testing.assert_allclose(jax.vmap(jax.grad(loss))(batch), slopes, **close)
    np.testing.assert_allclose(jax.jit(jax.grad(lambda b: loss(b).sum()))(batch), slopes, **close)
    double = [measured((np.float64(v), ring[1]), rest_surface=rest).volume for v in batch]
    np.testing.assert_allclose(values, double, rtol=1e-5 if dtype == np.float32 else 1e-12)


def test_equal_options_are_equal():
    vertices = jnp.asarray(ROW[0], "float32")

    def call(groups, rest):
        options = {"face_groups": groups, "ignore_groups": [[0, 4]], "rest_surface": rest}
        return self_intersection_penalty(vertices, ROW[1], **options)

    rest = RestSurface(*ROW, distance=0.01)
    first = call(GROUPS, rest)
    same = as_exclusions(GROUPS, ((0, 4),), rest, ROW[1])
    for groups in (GROUPS.copy(), GROUPS.astype(np.int16), jnp.asarray(GROUPS)):
        again = RestSurface(ROW[0].copy(), ROW[1].astype(np.int32), distance=0.01)
        assert call(groups, again) == first
        other = as_exclusions(groups, ((4, 0), (0, 4)), again, ROW[1])
        assert other == same and hash(other) == hash(same)
    assert as_exclusions(GROUPS, ((0, 9),), rest, ROW[1]) != same
    assert as_exclusions(GROUPS + 0, ((0, 4),), rest.within(0.02), ROW[1]) != same


def test_a_part_within_another_is_of_its_group():
    nested = join(box(), box((0.5, 0.4, 0.3), (0.01, 0.02, 0.03)))
    groups = np.repeat([0, 1], 12)
    vertices, faces = jnp.asarray(nested[0], "float32"), nested[1]
    for ignored, part in ((((0, 1),), 0.0), (((0, 0),), 0.06)):
        options = {"face_groups": groups, "ignore_groups": ignored}
        value = self_intersection_penalty(vertices, faces, **options)
        assert float(value) == pytest.approx(part, rel=1e-2)
        assert float(classify_vertices(vertices, faces, **options).ratio) == (0.5 if part else 0)


def test_turning_the_body_turns_no_fold_into_a_collision(rng):
    """Nor changes how much one is, to what float32 holds of the vertices."""
    rest = embedded_body().rest_surface
    for name, collides in (("run/0005", False), ("cartwheel/0103", True)):
        (vertices,) = posed_bodies([name])
        straight = intersection_report(vertices, body_faces(), rest_surface=rest)
        assert (straight.volume > 0) == (straight.intersecting_pairs > 0) == collides
        for _ in range(3):
            turned = vertices @ random_rotation(rng).T
            found = intersection_report(turned, body_faces(), rest_surface=rest)
            assert found.volume == pytest.approx(straight.volume, rel=1e-9)
            assert found.intersecting_pairs == straight.intersecting_pairs


def test_the_rest_surface_of_other_faces_is_refused(untyped):
    body = embedded_body()
    vertices, faces = jnp.asarray(body.template, "float32"), np.asarray(body.faces)
    with pytest.raises(ValueError, match="rest_surface must have these faces"):
        self_intersection_penalty(vertices, faces[::-1].copy(), rest_surface=body.rest_surface)
    scene = join_bodies(jnp.stack([vertices, vertices + 3.0]), faces)
    rest = body.rest_surface.copies(2)
    assert self_intersection_penalty(scene.vertices, scene.faces, rest_surface=rest) == 0
