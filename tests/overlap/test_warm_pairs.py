"""What is kept of a mesh makes the next call faster and changes nothing, to the bit."""

import gc
import weakref
from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import body_faces, embedded_body, join, mocap, random_rotation, sphere

from spt_jax import clear_caches
from spt_jax.overlap.measure import Sampling, measure
from spt_jax.overlap.triangles import pair_boxes, pair_layout, warm_pairs
from spt_jax.overlap.triangles.pair_layout import prepared
from spt_jax.overlap.triangles.predicates import Predicates

EXACT = Sampling(None, ((1.0, 0.0, 0.0),))


def body_steps(rng, count):
    """Frames of motion capture, and from each a walk through poses a millimetre apart."""
    body, frames = embedded_body(), rng.integers(0, len(mocap().names), 2)
    poses = []
    for frame in frames.tolist():
        pose = body.pose_from_smpl(jnp.asarray(mocap().pose[frame]))
        step = rng.normal(size=pose.shape).astype(np.float32) * 2e-4
        poses += [pose + k * step for k in range(count)]
    return np.asarray(body(jnp.stack(poses)).vertices, np.float64), body_faces().astype(np.int64)


def ball_steps(rng, count):
    """Two balls that come nearer, turn and grow, on the way past a power of two."""
    first, second = sphere(subdivisions=3), sphere(0.5, (0.9, 0.1, 0.0), subdivisions=3)
    shapes = []
    for k in range(2 * count):
        turn = random_rotation(rng) if k % 5 == 4 else np.eye(3)
        pair, faces = join(first, (second[0] - [0.0005 * k, 0.0, 0.0], second[1]))
        shapes.append((0.713 + 0.0002 * k) * pair @ turn.T)
    return np.array(shapes), np.asarray(faces, np.int64)


def noise_steps(rng, count):
    """One ball whose vertices tremble, by more and more, and of which one flies away at last."""
    vertices, faces = sphere(subdivisions=4)
    shapes = [
        vertices + 10.0 ** (-6 + 5 * k / (2 * count)) * rng.normal(size=vertices.shape)
        for k in range(2 * count)
    ]
    shapes[-1][7] *= 30.0
    return np.array(shapes), np.asarray(faces, np.int64)


BODIES = [body_steps, ball_steps, noise_steps]


def results(vertices, faces):
    found = measure(vertices, faces, EXACT)
    gradient = found.gradient("boundary", "vertex")
    contours = found.surface.contours
    numbers = np.array([found.volume]), gradient, found.labels("vertex"), contours.pair
    return b"".join(np.ascontiguousarray(x).tobytes() for x in (*numbers, contours.point))


def cold(vertices, faces):
    pair_layout._meshes.clear()
    return results(vertices, faces)


@pytest.fixture(scope="module")
def shapes():
    """Every shape of three bodies, with what a first call says of it."""
    rng = np.random.default_rng(11)
    found = []
    for steps in BODIES:
        meshes, faces = steps(rng, 4)
        faces.flags.writeable = False
        found += [(vertices, faces, cold(vertices, faces)) for vertices in meshes]
    return found


@pytest.mark.parametrize("order", ["in order", "backwards", 0, 1, 2])
def test_any_order_of_calls_gives_what_first_calls_give(shapes, order):
    pair_layout._meshes.clear()
    if isinstance(order, int):
        order = np.random.default_rng(order).permutation(len(shapes)).tolist()
    else:
        order = list(range(len(shapes)))[:: -1 if order == "backwards" else 1]
    for k in order:
        vertices, faces, expected = shapes[k]
        assert results(vertices, faces) == expected, k


def test_threads_change_nothing(shapes):
    pair_layout._meshes.clear()

    def all_of_them(seed):
        order = np.random.default_rng(seed).permutation(len(shapes)).tolist()
        return [k for k in order if results(*shapes[k][:2]) != shapes[k][2]]

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(all_of_them, range(4))) == [[]] * 4


def pairs_of(mesh, vertices, kept):
    """The pairs, with what is kept or anew; and what is kept afterwards."""
    faces = mesh.topology.faces
    predicates = Predicates(vertices, faces)
    points = predicates.points
    layout, *rest = pair_boxes.near_groups(mesh, points)
    mesh.kept = kept
    parts = list(warm_pairs.warm_pairs(mesh, points, predicates.scale, layout, *rest))
    t, u = pair_boxes.concatenate(parts)
    return {frozenset(pair) for pair in np.stack([t, u], axis=1).tolist()}, mesh.kept


@pytest.mark.parametrize("steps", BODIES)
def test_kept_pairs_lose_none_and_add_none(steps):
    meshes, faces = steps(np.random.default_rng(5), 6)
    mesh = prepared(faces, len(meshes[0]))
    kept, used = None, 0
    for vertices in meshes:
        anew, _ = pairs_of(mesh, vertices, None)
        known, after = pairs_of(mesh, vertices, kept)
        assert known == anew and len(anew) > 0
        used += kept is not None and kept.pairs is not None and after is kept
        kept = after
    assert used >= 2  # else nothing was tried


def test_few_groups_are_searched_where_the_body_moved_a_millimetre(monkeypatch):
    meshes, faces = body_steps(np.random.default_rng(2), 2)
    mesh = prepared(faces, len(meshes[0]))
    _, kept = pairs_of(mesh, meshes[0], None)
    assert kept.pairs is None  # of a first mesh only its points
    _, kept = pairs_of(mesh, meshes[0], kept)
    searched, all_of_them = [], warm_pairs.across_groups

    def counted(layout, shape, clusters, groups, marked=None):
        searched.append(sum(len(a) for a, _ in groups))
        return all_of_them(layout, shape, clusters, groups, marked)

    monkeypatch.setattr(warm_pairs, "across_groups", counted)
    pairs_of(mesh, meshes[1], kept)
    assert mesh.kept is kept and searched[0] < warm_pairs._FEW * mesh.usual_pairs
    pairs_of(mesh, meshes[2], kept)  # another frame
    assert mesh.kept is not kept and searched[1] >= mesh.usual_pairs // 2


def test_what_is_kept_is_bounded_and_given_back(monkeypatch):
    vertices, faces = sphere(subdivisions=3)
    faces = np.asarray(faces, np.int64)
    for _ in range(2):
        results(vertices, faces)
    kept = prepared(faces, len(vertices)).kept
    size = kept.points.nbytes + kept.pairs.nbytes
    assert 0 < size < 200 * len(faces)
    gone = weakref.ref(kept)
    del kept
    clear_caches()
    gc.collect()
    assert gone() is None
    # Too many pairs, or groups, are not kept.
    expected = results(vertices, faces)
    for name in ("_MOST_PAIRS_EACH", "_MOST_GROUPS"):
        pair_layout._meshes.clear()
        with monkeypatch.context() as changed:
            changed.setattr(warm_pairs, name, 0)
            for _ in range(3):
                assert results(vertices, faces) == expected
            kept = prepared(faces, len(vertices)).kept
            assert kept is None or kept.pairs is None
