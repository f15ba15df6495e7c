"""Distances along a rest surface against Dijkstra's paths, one face at a time."""

import heapq

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import bent_tube, body_faces, box, embedded_body, join, moved, random_rotation, sphere

from spt_jax.rest import paths
from spt_jax.rest.surface import RestSurface, local_distances


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
    monkeypatch.setattr(paths, "_SEEDS", 12)
    monkeypatch.setattr(paths, "_MOST_ANSWERS", 20 * len(PAIR[1]))
    paths._shared.cache_clear()
    rest = RestSurface(*PAIR, distance=distance)
    sources = np.arange(0, rest.num_faces, 97)
    f, g = all_pairs(sources, rest.num_faces)
    true = np.concatenate([slow_distances(*PAIR, s) for s in sources])
    clear = np.abs(true - distance) > 1e-9
    for _ in range(2):  # the second time from the answers kept
        np.testing.assert_array_equal(rest.near(f, g, exact=True)[clear], true[clear] < distance)
        np.testing.assert_array_equal(rest.near(g, f, exact=True)[clear], true[clear] < distance)
    paths._shared.cache_clear()


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
    monkeypatch.setattr(paths, "_SEEDS", seeds)
    paths._shared.cache_clear()
    rest = RestSurface(*PAIR)
    sources = np.arange(3, rest.num_faces, 173)
    true = np.concatenate([slow_distances(*PAIR, s) for s in sources])
    lower, upper = rest._bounds(*all_pairs(sources, rest.num_faces))
    assert (lower >= 0).all()
    assert (lower <= true + 1e-5).all() and (true <= upper + 1e-5).all()
    paths._shared.cache_clear()


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
    allowed = np.minimum(rest.distances[f], rest.distances[g])
    np.testing.assert_array_equal(rest.near(f, g, exact=True), true < allowed)
    np.testing.assert_array_equal(rest.within(0.3).near(f, g, exact=True), true < 0.3)
    assert (allowed < 0.3).any() and 0.02 < (true < 0.3).mean() < 0.5


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
    joined = RestSurface(*join(PAIR, moved(PAIR, translation=(20.0, 0.0, 0.0))), distance=0.5)
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


# Distances by place


def test_a_pair_is_near_by_the_smaller_of_its_distances():
    vertices, faces = TUBE
    wide = np.arange(len(faces)) > len(faces) // 2
    allowed = np.where(wide, 0.6, 0.2)
    rest = RestSurface(vertices, faces, allowed)
    assert (
        rest.distance == 0.6
        and repr(rest) == f"RestSurface({len(faces)} faces, distance=0.2 to 0.6)"
    )
    np.testing.assert_array_equal(rest.distances, allowed)
    f, g = all_pairs(np.arange(0, len(faces), 97), len(faces))
    for exact in (False, True):
        small, large = (RestSurface(vertices, faces, d).near(f, g, exact) for d in (0.2, 0.6))
        expected = np.where(wide[f] & wide[g], large, small)
        assert (large != small).any()
        np.testing.assert_array_equal(rest.near(f, g, exact), expected)
        np.testing.assert_array_equal(rest.near(g, f, exact), expected)


def test_distances_by_place_are_part_of_the_content():
    vertices, faces = box()
    allowed = np.linspace(0.1, 0.3, len(faces))
    rest = RestSurface(vertices, faces, allowed)
    assert rest == RestSurface(vertices, faces, allowed.copy()) == rest.within(allowed)
    assert hash(rest) == hash(rest.within(allowed))
    assert rest != RestSurface(vertices, faces, allowed[::-1])
    assert rest != RestSurface(vertices, faces, 0.3) != rest.within(0.2)
    assert rest.within(np.full(len(faces), 0.2)) == RestSurface(vertices, faces, 0.2)
    twice = rest.copies(2)
    np.testing.assert_array_equal(twice.distances, np.tile(allowed, 2))
    assert repr(twice) == "RestSurface(24 faces, distance=0.1 to 0.3, copies=2)"
    first, second = np.array([3]), np.array([7])
    assert twice.near(first + 12, second + 12) == rest.near(first, second)
    assert not twice.near(first, second + 12, exact=True).any()


def test_many_distances_are_rounded_down_to_few():
    vertices, faces = TUBE
    allowed = np.geomspace(0.01, 1.0, len(faces))
    got = RestSurface(vertices, faces, allowed).distances
    assert (got <= allowed * (1 + 1e-12)).all() and (got > 0.8 * allowed).all()
    assert len(np.unique(got)) <= 32
    allowed[:7] = 0.0
    assert (RestSurface(vertices, faces, allowed).distances[:7] == 0).all()


BY_PLACE = {
    "too few": (np.ones(3), ValueError, "one for each of the 12 faces: got .* shape \\(3,\\)"),
    "one endless": (np.r_[np.ones(11), np.inf], ValueError, "got .*inf.* for face 11"),
    "one negative": (np.r_[-1.0, np.ones(11)], ValueError, "got .*-1.0.* for face 0"),
    "words": (np.full(12, "a"), ValueError, "distance must be a number or one for each"),
}


@pytest.mark.parametrize("name", BY_PLACE)
def test_wrong_distances_are_named(name, untyped):
    distance, kind, message = BY_PLACE[name]
    with pytest.raises(kind, match=message):
        RestSurface(VERTICES, FACES, distance)
    with pytest.raises(kind, match=message):
        RestSurface(VERTICES, FACES).within(distance)


def test_parts_that_lie_in_each_other_at_rest():
    """Enclosed ones, intersecting ones, and of several copies only each one's own."""
    solids = [
        box(),
        box((0.2, 0.2, 0.2)),
        box((0.3, 0.3, 0.3), (0.5, 0.1, 0.2)),
        box((0.2, 0.2, 0.2), (3.0, 0.0, 0.0)),
    ]
    rest = RestSurface(*join(*solids))
    first = 12 * np.arange(4)
    f, g = (x.ravel() for x in np.meshgrid(first, first))
    found = rest.overlap_at_rest(f, g).reshape(4, 4)
    expected = np.zeros((4, 4), bool)
    for pair in ((0, 1), (0, 2)):
        expected[pair] = expected[pair[::-1]] = True
    np.testing.assert_array_equal(found, expected)
    two = rest.copies(2)
    np.testing.assert_array_equal(two.overlap_at_rest(f + 48, g + 48), found.ravel())
    assert not two.overlap_at_rest(f, g + 48).any()
    assert not embedded_body().rest_surface.overlap_at_rest(f, g).any()


# Distances from local thickness


def rod(radius, height, sides=24):
    """A closed tube along z, with a radius for each of its rings."""
    rings = len(radius)
    around = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    circle = np.stack([np.cos(around), np.sin(around)], axis=1)
    wall = np.concatenate(
        [radius[:, None, None] * circle, np.broadcast_to(height[:, None, None], (rings, sides, 1))],
        axis=2,
    )
    vertices = np.concatenate([wall.reshape(-1, 3), [[0, 0, height[0]], [0, 0, height[-1]]]])
    k, after = np.arange(sides), (np.arange(sides) + 1) % sides
    faces = [np.stack([after, k, np.full(sides, len(vertices) - 2)], axis=1)]
    for low in sides * np.arange(rings - 1):
        a, b, c, d = low + k, low + after, low + sides + after, low + sides + k
        faces += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    top = sides * (rings - 1)
    faces.append(np.stack([top + k, top + after, np.full(sides, len(vertices) - 1)], axis=1))
    return vertices, np.concatenate(faces)


@pytest.mark.parametrize("radius", [0.01, 1.0])
def test_a_cylinder_allows_half_its_girth(radius):
    vertices, faces = rod(np.full(41, radius), radius * np.linspace(0, 10, 41))
    found = local_distances(vertices, faces, girths=0.5)
    assert np.median(found) == pytest.approx(np.pi * radius, rel=0.01)
    assert found.max() < 1.01 * np.pi * radius and found.min() > 0.7 * np.pi * radius  # at the lids
    np.testing.assert_allclose(local_distances(vertices, faces), 1.6 * found, rtol=1e-12)


def test_what_is_thin_allows_less():
    """A thin rod that grows out of a thick one: each has its own girth, a few radii apart."""
    height = np.linspace(0, 4, 161)
    vertices, faces = rod(np.where(height < 2, 0.3, 0.05), height)
    found = local_distances(vertices, faces, girths=0.5)
    z = vertices[faces, 2].mean(axis=1)
    assert np.median(found[z < 2]) == pytest.approx(np.pi * 0.3, rel=0.02)
    assert np.median(found[z > 3.2]) == pytest.approx(np.pi * 0.05, rel=0.02)
    assert (np.abs(found[(z > 3.2) & (z < 3.9)] / np.pi - 0.05) < 0.005).all()


def test_local_distances_follow_the_mesh(rng):
    vertices, faces = TUBE
    found = local_distances(vertices, faces)
    np.testing.assert_array_equal(local_distances(4 * vertices, faces), 4 * found)
    turned, _ = moved((vertices, faces), random_rotation(rng), (0.3, -2.0, 1.0), 0.37)
    np.testing.assert_allclose(local_distances(turned, faces), 0.37 * found, rtol=1e-5)
    order = rng.permutation(len(faces))
    np.testing.assert_allclose(local_distances(vertices, faces[order]), found[order], rtol=1e-5)
    both = local_distances(*join(TUBE, moved(TUBE, translation=(9.0, 0.0, 0.0))))
    np.testing.assert_allclose(both, np.tile(found, 2), rtol=1e-9)


def test_local_distances_on_a_body():
    """Less on fingers than on limbs, less there than on the trunk; as far as folds reach."""
    body = embedded_body()
    found = local_distances(body.template, body.faces)
    joint = {name: number for number, name in enumerate(body.joint_names)}
    median = {name: np.median(found[body.part_groups == joint[name]]) for name in joint}
    assert 0.02 < median["left_index2"] < 0.06 < median["left_wrist"] < median["left_elbow"]
    assert median["left_elbow"] < median["left_hip"] < median["spine2"] < 0.7


def test_local_distances_of_what_has_no_volume():
    assert local_distances(np.zeros((3, 3)), np.zeros((0, 3), int)).shape == (0,)
    line = local_distances(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]))
    assert (line == 0).all()
    flat = local_distances(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    assert (flat > 1.0).all()  # a sheet has no inside


def test_wrong_girths_are_named(untyped):
    with pytest.raises(TypeError, match="girths must be a number: got 'half'"):
        local_distances(VERTICES, FACES, "half")
    with pytest.raises(ValueError, match="girths must be finite and not negative: got -1"):
        local_distances(VERTICES, FACES, -1)
    with pytest.raises(ValueError, match="rest_vertices must be finite"):
        local_distances(VERTICES * np.nan, FACES)
