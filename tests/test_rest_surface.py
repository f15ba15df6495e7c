"""Distances along a rest surface against Dijkstra's paths, one face at a time."""

import heapq

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import bent_tube, body_faces, box, embedded_body, join, sphere

from spt_jax import surface_paths
from spt_jax.rest_surface import RestSurface


def slow_distances(vertices, faces, source):
    """From one triangle's corners to the nearest of all others', by a heap and nothing else."""
    ways = [[] for _ in vertices]
    starts, ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    lengths = np.linalg.norm(vertices[starts] - vertices[ends], axis=1)
    for p, q, length in zip(starts.tolist(), ends.tolist(), lengths.tolist(), strict=True):
        ways[p].append((q, length))
        ways[q].append((p, length))
    to = np.full(len(vertices), np.inf)
    heap = [(0.0, v) for v in faces[source].tolist()]
    while heap:
        length, v = heapq.heappop(heap)
        if length < to[v]:
            to[v] = length
            for w, further in ways[v]:
                heapq.heappush(heap, (length + further, w))
    return to[faces].min(axis=1)


# Two pieces, a vertex that no triangle uses, and two vertices at one place.
TUBE = bent_tube(0.5, 0.2, 0.1, sides=10, steps=60)
PAIR = join(TUBE, sphere(0.3, center=(4.0, 0.0, 0.0), subdivisions=2))
PAIR = (np.concatenate([PAIR[0], [[9.0, 9.0, 9.0]]]), PAIR[1])


def all_pairs(sources, num_faces):
    return np.repeat(sources, num_faces), np.tile(np.arange(num_faces), len(sources))


@pytest.mark.parametrize("distance", [0.0, 0.4, 2.0])
def test_near_is_exact_where_asked(distance, monkeypatch):
    # Few seeds and little room for answers, so that every stage has something to decide.
    monkeypatch.setattr(surface_paths, "_SEEDS", 12)
    monkeypatch.setattr(surface_paths, "_MOST_ANSWERS", 20 * len(PAIR[1]))
    surface_paths._shared.cache_clear()
    rest = RestSurface(*PAIR, distance=distance)
    sources = np.arange(0, rest.num_faces, 97)
    f, g = all_pairs(sources, rest.num_faces)
    true = np.concatenate([slow_distances(*PAIR, s) for s in sources])
    clear = np.abs(true - distance) > 1e-9
    for _ in range(2):  # the second time from the answers kept
        np.testing.assert_array_equal(rest.near(f, g, exact=True)[clear], true[clear] < distance)
        np.testing.assert_array_equal(rest.near(g, f, exact=True)[clear], true[clear] < distance)
    surface_paths._shared.cache_clear()


def test_distances_are_close_symmetric_and_infinite_between_pieces():
    rest = RestSurface(*PAIR)
    sources = np.arange(0, rest.num_faces, 211)
    f, g = all_pairs(sources, rest.num_faces)
    true = np.concatenate([slow_distances(*PAIR, s) for s in sources])
    got = rest.between_faces(f, g)
    np.testing.assert_array_equal(np.isinf(got), np.isinf(true))
    assert np.isinf(got).any() and np.isfinite(got).any()
    assert got.dtype == np.float32
    same = np.isfinite(true)
    assert np.abs(got[same] - true[same]).max() < 0.15
    assert np.abs(got[same] - true[same]).mean() < 0.04
    np.testing.assert_array_equal(rest.between_faces(g, f), got)
    np.testing.assert_array_equal(rest.near(f, g), got < 0.3)


@pytest.mark.parametrize("seeds", [12, 512])
def test_bounds_hold_the_distance_between_them(seeds, monkeypatch):
    monkeypatch.setattr(surface_paths, "_SEEDS", seeds)
    surface_paths._shared.cache_clear()
    rest = RestSurface(*PAIR)
    sources = np.arange(3, rest.num_faces, 173)
    true = np.concatenate([slow_distances(*PAIR, s) for s in sources])
    lower, upper = rest._bounds(*all_pairs(sources, rest.num_faces))
    assert (lower >= 0).all()
    assert (lower <= true + 1e-5).all() and (true <= upper + 1e-5).all()
    surface_paths._shared.cache_clear()


def test_triangles_with_a_common_corner_have_no_distance():
    vertices, faces = sphere(0.3, subdivisions=2)
    f, g = all_pairs(np.arange(len(faces)), len(faces))
    touch = (faces[f][:, :, None] == faces[g][:, None]).any(axis=(1, 2))
    shortest = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2).min()
    for distance in (1e-9, 0.99 * shortest):
        rest = RestSurface(vertices, faces, distance)
        np.testing.assert_array_equal(rest.near(f, g, exact=True), touch)
    assert not RestSurface(vertices, faces, 0.0).near(f, g, exact=True).any()


def test_the_embedded_body_is_as_close_as_documented():
    body = embedded_body()
    rest = body.rest_surface
    vertices, faces = np.asarray(body.template, np.float64), body_faces()
    assert rest.num_faces == len(faces) and rest.distance == 0.3
    sources = [7000, 20000]
    true = np.concatenate([slow_distances(vertices, faces, source) for source in sources])
    f, g = all_pairs(sources, len(faces))
    error = np.abs(rest.between_faces(f, g) - true)
    assert error.max() < 0.05 and error.mean() < 0.012
    np.testing.assert_array_equal(rest.near(f, g, exact=True), true < 0.3)
    assert 0.02 < (true < 0.3).mean() < 0.5


def test_distances_grow_with_the_mesh():
    vertices, faces = TUBE
    f, g = all_pairs([5, 600], len(faces))
    one = RestSurface(vertices, faces).between_faces(f, g)
    eight = RestSurface(8 * vertices, faces).between_faces(f, g)  # exact in floating point
    np.testing.assert_array_equal(eight, 8 * one)


def test_copies_are_infinitely_far_apart():
    one = RestSurface(*PAIR, distance=0.5)
    three = one.copies(3)
    count = one.num_faces
    assert three.num_faces == 3 * count and three.distance == 0.5
    f, g = all_pairs([3, 900], count)
    np.testing.assert_array_equal(
        three.between_faces(f + count, g + count), one.between_faces(f, g)
    )
    np.testing.assert_array_equal(
        three.near(f + 2 * count, g + 2 * count, exact=True), one.near(f, g, exact=True)
    )
    assert np.isinf(three.between_faces(f, g + count)).all()
    assert not three.near(f, g + count, exact=True).any()
    joined = RestSurface(*join(PAIR, PAIR), distance=0.5)
    both = all_pairs([3, count + 900], 2 * count)
    np.testing.assert_array_equal(
        one.copies(2).near(*both, exact=True), joined.near(*both, exact=True)
    )
    assert one.copies(2).copies(3) == one.copies(6)


def test_equal_contents_are_one_option_to_jit():
    vertices, faces = box()
    first, second = RestSurface(vertices, faces), RestSurface(vertices.copy(), faces.astype("i4"))
    assert first is not second and first == second and hash(first) == hash(second)
    assert first != RestSurface(vertices, faces, 0.2) and first != RestSurface(2 * vertices, faces)
    assert first != first.copies(2) and first.within(0.2) == RestSurface(vertices, faces, 0.2)
    assert first._paths is second._paths is first.within(0.2)._paths
    traces = []

    def count(x, rest):
        traces.append(rest)
        return x

    jitted = jax.jit(count, static_argnums=1)
    jitted(jnp.ones(2), first)
    jitted(jnp.ones(2), second)
    assert len(traces) == 1
    with pytest.raises(AttributeError, match="distance cannot be set"):
        first.distance = 1.0
    vertices += 1  # its own copy: what hashes must not change
    assert RestSurface(vertices, faces) != first


def test_no_faces():
    rest = RestSurface(np.zeros((3, 3)), np.zeros((0, 3), int))
    none = np.zeros(0, int)
    assert len(rest.between_faces(none, none)) == len(rest.near(none, none, exact=True)) == 0


def test_a_traced_body_says_what_to_do():
    body = embedded_body()
    with pytest.raises(TypeError, match=r"body.rest_surface\) outside jit"):
        jax.jit(lambda b: jnp.asarray(b.rest_surface.distance))(body)
    jax.jit(lambda x: x + body.rest_surface.distance)(jnp.ones(()))  # closed over: known


VERTICES, FACES = box()
ERRORS = {
    "shape": ((VERTICES[:, :2], FACES), ValueError, r"rest_vertices must have shape \(V, 3\)"),
    "batch": ((VERTICES[None], FACES), ValueError, "a batch shares one rest mesh"),
    "dtype": ((FACES, FACES), TypeError, "rest_vertices must be floating-point: got int64"),
    "faces dtype": ((VERTICES, FACES * 1.0), TypeError, "faces must be whole numbers"),
    "faces shape": ((VERTICES, FACES[:, :2]), ValueError, r"faces must have shape \(F, 3\)"),
    "nan": ((VERTICES * np.nan, FACES), ValueError, "must be finite: got .* in row 0"),
    "index": ((VERTICES, FACES + 1), ValueError, "got index 8 for 8 vertices"),
    "negative": ((VERTICES, FACES, -0.1), ValueError, "distance must be finite and not.*-0.1"),
    "endless": ((VERTICES, FACES, np.inf), ValueError, "distance must be finite"),
    "text": ((VERTICES, FACES, "0.3"), TypeError, "distance must be a number: got '0.3'"),
    "pieces": (
        (np.tile(VERTICES, (600, 1)), np.concatenate([FACES + 8 * k for k in range(600)])),
        ValueError,
        "at most 512 pieces: got 600",
    ),
}


@pytest.mark.parametrize("name", ERRORS)
def test_wrong_input_is_named(name, untyped):
    arguments, kind, message = ERRORS[name]
    with pytest.raises(kind, match=message):
        RestSurface(*arguments)


@pytest.mark.parametrize("count", [0, -1, 1.5, True])
def test_copies_are_counted_in_whole_numbers(count, untyped):
    with pytest.raises(ValueError, match="count must be a positive whole number"):
        RestSurface(VERTICES, FACES).copies(count)
