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
from spt_jax.overlap.triangles import near_triangles, pair_boxes, pair_layout, warm_pairs
from spt_jax.overlap.triangles.gaps import gaps
from spt_jax.overlap.triangles.pair_layout import CLUSTER, prepared
from spt_jax.overlap.triangles.pairs import edge_intersections, face_pairs
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


def unseen(mesh, vertices):
    """What is left to look at of a shape, and the crossings of a first call that it leaves out."""
    faces, left = mesh.topology.faces, None
    signs = Predicates(vertices, faces)
    near = warm_pairs.nearest(mesh, signs.points, signs.scale)
    left = warm_pairs.left_of(mesh, near, signs.points)
    if left is None:
        return None, 0
    slot = left.layout.slot
    with pytest.MonkeyPatch.context() as changed:
        changed.setattr(near_triangles, "left_of", lambda *_: None)
        changed.setattr(near_triangles, "keep", lambda *_: None)
        pairs = face_pairs(edge_intersections(vertices, faces))
    looked_at = {frozenset(pair) for pair in left.pairs.T.tolist()}
    groups = {frozenset(pair) for pair in left.groups.T.tolist()}
    missing = 0
    for f, g in pairs.tolist():
        shared = np.intersect1d(faces[f], faces[g])
        ends = slot[f], slot[g]
        if len(shared):
            missing += not np.isin(shared, left.vertex).any()
        elif frozenset(x // CLUSTER**2 for x in ends) not in groups:
            missing += frozenset(ends) not in looked_at
    return left, missing


@pytest.mark.parametrize("steps", BODIES)
def test_what_crosses_is_always_looked_at(steps):
    meshes, faces = steps(np.random.default_rng(5), 6)
    pair_layout._meshes.clear()
    mesh = prepared(faces, len(meshes[0]))
    used = 0
    for vertices in meshes:
        left, missing = unseen(mesh, vertices)
        assert missing == 0
        used += left is not None
        results(vertices, faces)
    assert used >= 2  # else nothing was tried


def test_little_is_looked_at_where_the_body_moved_a_millimetre():
    meshes, faces = body_steps(np.random.default_rng(2), 3)
    pair_layout._meshes.clear()
    mesh = prepared(faces, len(meshes[0]))
    results(meshes[0], faces)
    assert mesh.kept[0].apart is None  # of a first mesh only its points
    results(meshes[1], faces)
    (kept,) = mesh.kept
    left, _ = unseen(mesh, meshes[2])
    assert left.pairs.shape[1] < 0.05 * kept.apart.pairs.shape[1]
    assert len(left.vertex) < 0.05 * len(meshes[2])
    assert left.groups.shape[1] < 0.05 * kept.apart.groups.shape[1]
    assert mesh.kept == (kept,) and mesh.waste == 0
    assert unseen(mesh, meshes[3])[0] is None  # another frame
    assert mesh.kept == (kept,)


def test_shapes_that_come_in_turn_are_all_kept():
    """A batch's meshes move a little from one call to the next, and are far from each other."""
    meshes, faces = body_steps(np.random.default_rng(3), 4)
    pair_layout._meshes.clear()
    mesh = prepared(faces, len(meshes[0]))
    used = []
    for k in (0, 4, 1, 5, 2, 6, 3, 7):  # two frames, in turn
        used.append(unseen(mesh, meshes[k])[0] is not None)
        results(meshes[k], faces)
    assert used == 4 * [False] + 4 * [True]
    assert len(mesh.kept) == 2


def test_what_was_of_no_use_is_kept_later():
    """Frames that come in twos would pay for a list each, and use none."""
    vertices, faces = sphere(subdivisions=3)
    faces = np.asarray(faces, np.int64)
    pair_layout._meshes.clear()
    mesh = prepared(faces, len(vertices))
    made = []
    with pytest.MonkeyPatch.context() as changed:
        changed.setattr(warm_pairs, "_SHAPES", 2)
        for k in range(40):
            turn = random_rotation(np.random.default_rng(k // 2))
            results(vertices @ turn.T, faces)
            made.append(bool(mesh.kept) and mesh.kept[0].apart is not None)
            assert len(mesh.kept) <= 2
    assert made[1] and 2 <= sum(made) <= 5
    for _ in range(warm_pairs._MOST_PATIENCE + 3):
        results(vertices, faces)
    last = next(iter(mesh.kept))
    assert last.apart is not None


def test_gaps_are_lower_bounds_and_told_of_all_that_are_apart(rng):
    corners = rng.uniform(-1, 1, (400, 3, 3)) * rng.choice([0.05, 0.3, 1.0], (400, 1, 1))
    corners[::7, :, 2] = 0.25  # in one plane
    vertices, faces = corners.reshape(-1, 3), np.arange(1200).reshape(-1, 3)
    mesh = pair_layout.Prepared(prepared(faces, len(vertices)).topology)
    layout, shape, *_ = pair_boxes.near_groups(mesh, vertices.T.copy())
    f, g = rng.integers(0, 400, (2, 3000))
    f, g = f[f != g], g[f != g]
    found = gaps(shape, layout.slot[f], layout.slot[g], np.inf)
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 9)] * 2), -1).reshape(-1, 2)
    grid = grid[grid.sum(axis=1) <= 1]
    weights = np.column_stack([1 - grid.sum(axis=1), grid])
    for pair in range(0, len(f), 20):
        one, other = (weights @ corners[x[pair]] for x in (f, g))
        nearest = np.linalg.norm(one[:, None] - other, axis=2).min()
        assert found[pair] <= nearest
    crossing = {tuple(x) for x in face_pairs(edge_intersections(vertices, faces)).tolist()}
    meets = np.array([(min(x), max(x)) in crossing for x in zip(f, g, strict=True)])
    flat = (f % 7 == 0) & (g % 7 == 0)  # where they touch, ties decide
    np.testing.assert_array_equal(found[~flat] <= 0, meets[~flat])
    assert (found[flat] > 0).any() and not meets[found > 0].any()


def test_what_is_kept_is_bounded_and_given_back(monkeypatch):
    vertices, faces = sphere(subdivisions=3)
    faces = np.asarray(faces, np.int64)
    pair_layout._meshes.clear()
    for _ in range(2):
        results(vertices, faces)
    (kept,) = prepared(faces, len(vertices)).kept
    assert kept.apart is not None
    known = (*vars(kept).values(), *vars(kept.apart).values())
    assert 0 < sum(x.nbytes for x in known if isinstance(x, np.ndarray)) < 400 * len(faces)
    del known
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
            assert all(one.apart is None for one in kept)
