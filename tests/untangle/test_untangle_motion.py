"""untangle_motion: free of collisions, as smooth as before, and calm frames to the bit."""

import itertools
import json

import ipctk
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import embedded_body, mocap
from helpers_motion import second_differences, skin, snap, tongs

from spt_jax import RESULTS, untangle_motion, untangle_pose
from spt_jax.untangle import motion_run, motion_window
from spt_jax.untangle.corrections import Frames, as_given, corrected
from spt_jax.untangle.feet import feet_of, standing_feet
from spt_jax.untangle.frame_cuts import FrameCuts
from spt_jax.untangle.motion_contacts import as_motion_contacts, kept_contacts
from spt_jax.untangle.motion_input import as_frames
from spt_jax.untangle.motion_window import windows


def crosses(body, vertices):
    """Of each frame, whether ipctk finds an intersection."""
    faces = np.asarray(body.faces, np.int32)
    mesh = ipctk.CollisionMesh(vertices[0], ipctk.edges(faces), faces)
    return np.array([ipctk.has_intersections(mesh, np.asfortranarray(v)) for v in vertices])


def test_a_motion_comes_free_and_stays_smooth():
    body, pose = tongs(), snap()
    result = untangle_motion(body, pose)
    before, after = skin(body, pose), skin(body, result.pose)
    assert crosses(body, before).sum() > 5 and not crosses(body, after).any()
    np.testing.assert_array_equal(result.before.is_free, ~crosses(body, before))
    assert np.asarray(result.is_free).all() and set(result.reason) == {"collision-free"}
    given, found = second_differences(before), second_differences(after)
    assert found.max() <= 1.5 * given.max()
    assert np.quantile(found, 0.95) <= 1.2 * np.quantile(given, 0.95)
    colliding, alone = ~result.before.is_free, pose.copy()
    alone[colliding] = untangle_pose(body, jnp.asarray(pose[colliding])).pose
    single = skin(body, alone)
    assert second_differences(single).max() > 1.2 * found.max()
    moved, alone = (np.linalg.norm(x - before, axis=-1)[colliding].mean() for x in (after, single))
    assert 0 < moved < 1.3 * alone
    np.testing.assert_array_equal(result.pose[:, 0], pose[:, 0])  # the root stays


def test_frames_far_from_a_collision_are_those_given_to_the_bit():
    body, pose = tongs(), snap(frames=101)
    result = untangle_motion(body, pose)
    hit = np.flatnonzero(~result.before.is_free)
    far = np.ones(len(pose), bool)
    far[hit.min() - 15 : hit.max() + 16] = False  # five times 0.05 s are fewer
    assert far.sum() > 50 and not result.moved[far].any() and result.moved[hit].all()
    np.testing.assert_array_equal(np.asarray(result.pose)[far], pose[far])
    still = untangle_motion(body, pose[: hit.min()])
    np.testing.assert_array_equal(still.pose, pose[: hit.min()])
    assert still.rounds == 0 and not still.moved.any() and np.asarray(still.is_free).all()


@pytest.mark.long
def test_backwards_is_the_same_motion_backwards(x64):
    body, pose = tongs(dtype="float64"), snap(dtype="float64")
    there = untangle_motion(body, pose)
    back = untangle_motion(body, pose[::-1])
    np.testing.assert_allclose(back.pose[::-1], there.pose, atol=1e-9)
    assert back.rounds == there.rounds


def test_one_frame_is_as_free_as_a_pose():
    body, pose = tongs(), snap()[20:21]
    whole, single = untangle_motion(body, pose), untangle_pose(body, jnp.asarray(pose[0]))
    assert np.asarray(whole.is_free).tolist() == [True] and bool(single.is_free)
    np.testing.assert_allclose(whole.before.volume[0], single.before.volume, rtol=1e-5)
    start = skin(body, pose)
    moved, alone = (
        np.linalg.norm(skin(body, jnp.asarray(p).reshape(pose.shape)) - start, axis=-1).mean()
        for p in (whole.pose, single.pose)
    )
    assert 0.5 * alone < moved < 1.5 * alone


def test_a_search_that_finds_nothing_changes_nothing(monkeypatch):
    """Corrections that press the arms together: the motion given comes back."""

    def harmful(self, known, stiffness, ties):
        count, size = known.mean.shape
        return known.mean + 0.1 * np.linspace(-1, 1, count * size).reshape(count, size)

    monkeypatch.setattr(FrameCuts, "minimum", harmful)
    body, pose = tongs(), snap()
    result = untangle_motion(body, pose)
    np.testing.assert_array_equal(result.pose, pose)
    np.testing.assert_array_equal(result.after.volume, result.before.volume)
    hit = ~result.before.is_free
    np.testing.assert_array_equal(result.status == RESULTS.intersections_left, hit)
    assert not result.moved.any()


@pytest.mark.long
def test_long_collisions_are_freed_in_pieces_without_a_seam(monkeypatch):
    monkeypatch.setattr(motion_run, "_LONGEST", 30.0)
    monkeypatch.setattr(motion_run, "_SHORTEST", 0)
    body, steps = tongs(), []
    pose = snap(frames=60, width=25.0)
    result = untangle_motion(body, pose, frames_per_second=20.0, fade=0.05, on_step=steps.append)
    starts = sorted({step.first for step in steps if step.stage == "freeing"})
    assert len(starts) > 1 and {step.frames for step in steps} == {60}
    assert np.asarray(result.is_free).all() and not crosses(body, skin(body, result.pose)).any()
    found = second_differences(skin(body, result.pose))
    for start in starts[1:]:
        assert not result.before.is_free[start - 1 : start + 1].any()
        assert found[start - 3 : start + 2].max() < found.max()


def test_windows_cover_what_collides_and_their_reach():
    colliding = np.zeros(200, bool)
    colliding[[3, 20, 100]] = True
    colliding[120:190] = True
    found = list(windows(colliding, 5, 40))
    assert found[:3] == [(0, 9, 9, True), (15, 26, 26, True), (95, 106, 106, True)]
    pieces = found[3:]
    assert pieces[0][0] == 115 and pieces[-1][1:] == (195, 195, True)
    for one, following in itertools.pairwise(pieces):
        assert one[2] == following[0] == one[1] - 5 and not one[3]


def test_how_a_rotation_is_written_does_not_matter():
    body, pose = tongs(), snap()
    turned = pose.copy()
    angle = np.linalg.norm(turned[::2, 1], axis=-1, keepdims=True)
    turned[::2, 1] *= (angle - 2 * np.pi) / angle  # the other way round, in every other frame
    np.testing.assert_allclose(skin(body, turned), skin(body, pose), atol=1e-6)
    one, other = untangle_motion(body, pose), untangle_motion(body, turned)
    np.testing.assert_allclose(skin(body, one.pose), skin(body, other.pose), atol=1e-3)
    assert (np.linalg.norm(np.asarray(other.pose)[::2, 1], axis=-1) > 4).all()


def test_rotations_are_written_as_those_given(x64):
    rng = np.random.default_rng(0)
    like = rng.normal(scale=3.0, size=(50, 4, 3))
    turned = np.asarray(corrected(jnp.asarray(like), jnp.zeros((50, 3, 3))))
    np.testing.assert_allclose(as_given(turned, like), like, atol=1e-9)


def test_feet_that_stand_move_less():
    """One arm of the tongs is named as a foot is; it stands where up is down."""
    body, pose = tongs(), snap()
    start, foot = skin(body, pose), feet_of(body)[0]
    light, heavy = (untangle_motion(body, pose, feet=w, up=(0, -1, 0)) for w in (0.0, 30.0))
    assert np.asarray(light.is_free).all() and np.asarray(heavy.is_free).all()
    moved = [
        np.linalg.norm(skin(body, r.pose) - start, axis=-1)[:, foot].max() for r in (light, heavy)
    ]
    assert moved[1] < 0.5 * moved[0]


def test_feet_stand_where_they_are_low_and_slow():
    body, pose = tongs(), snap()
    nowhere = np.zeros((len(pose), 3), np.float32)
    up = np.array([0.0, 1.0, 0.0])

    def share(translation, up, on_ground):
        frames = motion_frames(pose, translation)
        return standing_feet(body, frames, 30.0, up, on_ground=on_ground).share[:, 0, 0]

    assert not share(nowhere, up, False).any()  # the trunk is lower
    assert share(nowhere, -up, False).all()
    still = share(nowhere, -up, True)
    assert still[0] and not still[16:25].any()  # it leans, which is high and fast
    places = nowhere.copy()
    places[:20, 1] = -1.0  # higher by a metre, where up is down
    assert share(places, -up, True)[-1] and not share(places, -up, True)[:21].any()
    assert not share(
        nowhere + 0.1 * np.arange(len(pose), dtype=np.float32)[:, None], -up, True
    ).any()


def motion_frames(pose, translation):
    shape = np.zeros((len(pose), 1, 1), np.float32)
    return Frames(pose[:, None], shape, translation[:, None])


def test_shape_and_translation_of_each_frame_are_used():
    body, pose = tongs(), snap()
    places = np.linspace(0, 50, len(pose), dtype=np.float32)[:, None] * np.ones(3, np.float32)
    shape = np.zeros((len(pose), 1), np.float32)
    still, moving = untangle_motion(body, pose), untangle_motion(body, pose, translation=places)
    np.testing.assert_array_equal(still.before.is_free, moving.before.is_free)
    assert np.asarray(moving.is_free).all()
    same = untangle_motion(body, pose, shape=shape[0])
    np.testing.assert_array_equal(same.pose, untangle_motion(body, pose, shape=shape).pose)


def test_results_are_json_types():
    result = untangle_motion(tongs(), snap()[18:23])
    content = json.loads(json.dumps(result.as_dict()))
    assert content["frames"] == content["free_frames"] == 5
    assert content["before"]["colliding_frames"] > 0 == content["after"]["colliding_frames"]
    assert content["status"] == ["successful"] * 5 and "free frames" in str(result)


def test_what_a_step_raises_ends_the_search():
    class Enough(Exception):
        pass

    def stop(step):
        raise Enough

    with pytest.raises(Enough):
        untangle_motion(tongs(), snap(), on_step=stop)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"poses": np.zeros((2, 4, 3), np.float32)}, ValueError, "frames, 3, 3"),
        ({"poses": np.zeros((0, 3, 3), np.float32)}, ValueError, "at least one frame"),
        ({"translation": np.zeros((3, 3), np.float32)}, ValueError, "each of 41 frames"),
        ({"translation": np.zeros(2, np.float32)}, ValueError, "3 numbers"),
        ({"shape": np.array([np.inf], np.float32)}, ValueError, "shape must be finite"),
        ({"frames_per_second": 0.0}, ValueError, "frames_per_second must be finite and positive"),
        ({"fade": "long"}, TypeError, "fade must be a number"),
        ({"feet": -1.0}, ValueError, "not negative"),
        ({"up": (0, 0, 0)}, ValueError, "direction"),
        ({"margin": -1.0}, ValueError, "margin"),
    ],
)
def test_what_cannot_be_is_refused(untyped, change, error, message):
    with pytest.raises(error, match=message):
        untangle_motion(**({"body": tongs(), "poses": snap()} | change))


def test_frames_that_are_not_finite_are_named():
    pose = snap()
    pose[7, 1, 0], pose[9, 0, 0] = np.nan, np.inf
    with pytest.raises(ValueError, match=r"2 of 41 frames, frame 7 the first"):
        untangle_motion(tongs(), pose)
    with pytest.raises(TypeError, match="traced"):
        jax.jit(lambda p: untangle_motion(tongs(), p))(jnp.asarray(snap()))


def test_a_search_that_ends_early_keeps_the_best(monkeypatch):
    monkeypatch.setattr(motion_window, "_ROUNDS", 3)
    body, pose = tongs(), snap(lean=0.9)
    result = untangle_motion(body, pose)
    assert result.rounds == 3
    left = np.count_nonzero(~result.after.is_free)
    assert left <= np.count_nonzero(~result.before.is_free)


@pytest.mark.long
def test_a_real_motion():
    body = embedded_body()
    names = list(mocap().names)
    first = names.index("spinkick/0048")
    pose = np.asarray(body.pose_from_smpl(jnp.asarray(mocap().pose[first : first + 20])))
    result = untangle_motion(body, pose)
    assert np.count_nonzero(~result.before.is_free) > 8 and result.before.is_rejected
    assert np.asarray(result.is_free).all() and not result.after.is_rejected
    before, after = skin(body, pose), skin(body, result.pose)
    assert second_differences(after).max() < 1.2 * second_differences(before).max()
    assert np.linalg.norm(after - before, axis=-1).mean() < 0.03


def pair_of_people(frames=21, apart=0.42):
    """Two pairs of tongs side by side: the right arm of one leans into the left one of the other.

    The second one's own arms collide as well, a little later.
    """
    pose = np.zeros((frames, 2, 3, 3), np.float32)
    bump = np.exp(-(((np.arange(frames) - 8) / 2.5) ** 2) / 2)
    pose[:, 0, 2, 2], pose[:, 1, 1, 2] = -0.3 * bump, 0.3 * bump
    pose[:, :, :, 0] += 0.02
    own = 0.5 * np.exp(-(((np.arange(frames) - 14) / 2.0) ** 2) / 2)
    pose[:, 1, 1, 2] -= own
    pose[:, 1, 2, 2] += 0.9 * own
    places = np.zeros((frames, 2, 3), np.float32)
    places[:, 1, 0] = apart
    places[:, 1, 1] = 0.01
    return pose, places


@pytest.mark.long
def test_two_people_are_freed_together_and_counted_apart():
    body, (pose, places) = tongs(), pair_of_people()
    result = untangle_motion(body, pose, translation=places)
    assert result.pose.shape == pose.shape and np.asarray(result.is_free).all()
    posed = np.asarray(body(result.pose, translation=jnp.asarray(places)).vertices, np.float64)
    scene = posed.reshape(len(pose), -1, 3)
    faces = np.concatenate([np.asarray(body.faces), np.asarray(body.faces) + body.num_vertices])
    mesh = ipctk.CollisionMesh(scene[0], ipctk.edges(faces), faces)
    assert not any(ipctk.has_intersections(mesh, np.asfortranarray(v)) for v in scene)
    within, between = result.within[0], result.between[0]
    assert (within.intersecting_pairs > 0).any() and (between.intersecting_pairs > 0).any()
    np.testing.assert_array_equal(
        within.intersecting_pairs + between.intersecting_pairs, result.before.intersecting_pairs
    )
    np.testing.assert_allclose(
        within.volume + between.volume, result.before.volume, rtol=1e-6, atol=1e-12
    )
    alone = untangle_motion(body, pose[:, 1])
    np.testing.assert_array_equal(within.intersecting_pairs, alone.before.intersecting_pairs)
    assert not result.within[1].volume.any() and not result.between[1].volume.any()
    assert json.loads(json.dumps(result.as_dict()))["between_before"]["colliding_frames"] > 0
    assert alone.between is None and "between_before" not in alone.as_dict()
    with pytest.raises(ValueError, match="where 2 people are"):
        untangle_motion(body, pose)


def test_one_person_in_a_scene_is_one_person():
    body, pose = tongs(), snap()[14:27]
    one, other = untangle_motion(body, pose), untangle_motion(body, pose[:, None])
    np.testing.assert_array_equal(other.pose[:, 0], one.pose)


class Killed(Exception):
    pass


def test_a_run_that_was_ended_goes_on_to_the_same_bits(tmp_path, monkeypatch):
    body = tongs()
    pose = np.concatenate([snap(frames=31), snap(frames=31, lean=0.6)])
    whole = untangle_motion(body, pose)
    windows_seen, calls = [], []

    def stop(step):
        if step.stage == "freeing":
            windows_seen.append(step.first)
            if len(set(windows_seen)) > 1:
                raise Killed

    with pytest.raises(Killed):
        untangle_motion(body, pose, resume=tmp_path, on_step=stop)
    files = sorted(path.name for path in tmp_path.iterdir())
    assert "before_000000.npz" in files and sum("window" in name for name in files) == 1
    solve = motion_run.solve
    monkeypatch.setattr(motion_run, "solve", lambda *a: calls.append(1) or solve(*a))
    again = untangle_motion(body, pose, resume=tmp_path)
    assert len(calls) == 1
    np.testing.assert_array_equal(again.pose, whole.pose)
    np.testing.assert_array_equal(again.after.volume, whole.after.volume)
    assert again.rounds == whole.rounds
    kept = next(path for path in tmp_path.iterdir() if "window" in path.name)
    kept.write_bytes(kept.read_bytes()[:50])  # damaged: made again
    third = untangle_motion(body, pose, resume=tmp_path)
    np.testing.assert_array_equal(third.pose, whole.pose)
    assert len(calls) == 2
    with pytest.raises(ValueError, match="other options"):
        untangle_motion(body, pose, resume=tmp_path, margin=0.003)


def contact_left(weights):
    """How far the tips of the two arms, which nearly touch, are off in the last frame before they
    collide, in metres; the frame after it is tied as well, where contact has to give way.
    """
    body, pose = tongs(), snap()
    start = skin(body, pose)
    arms = [np.flatnonzero(np.asarray(body.weights)[:, k] > 0.5) for k in (1, 2)]
    frame = np.flatnonzero(crosses(body, start))[0] - 1
    gap = np.linalg.norm(start[frame][arms[0]][:, None] - start[frame][arms[1]], axis=-1)
    a, b = np.unravel_index(gap.argmin(), gap.shape)
    contact = np.array([[arms[0][a], arms[1][b]]])
    found = []
    for weight in weights:
        result = untangle_motion(
            body, pose, feet=0.0, contacts=contact, contact_distance=0.08, contact_weight=weight
        )
        after = skin(body, result.pose)
        change = [v[frame, contact[0, 0]] - v[frame, contact[0, 1]] for v in (start, after)]
        found.append(np.linalg.norm(change[1] - change[0]))
        assert result.is_free.all()
    return np.array(found)


@pytest.mark.slow
def test_wanted_contact_is_kept():
    """Freeing the arms alone pulls their tips apart."""
    found = contact_left((0.0, 3000.0))
    assert found[1] < 0.1 * found[0]


@pytest.mark.long
def test_contact_that_weighs_more_is_kept_as_well_or_better():
    found = contact_left((0.0, 20.0, 100.0, 500.0, 3000.0))
    assert found[1:].max() < 0.1 * found[0]  # 31 mm; 1.6 at most
    assert (np.diff(found) < 2e-3).all()


def test_contacts_that_are_none_are_refused():
    body, pose = tongs(), snap()
    for wrong in ([[0, 10**6]], [0, 1]):
        with pytest.raises(ValueError, match="contacts must be pairs"):
            untangle_motion(body, pose, contacts=np.array(wrong))
    with pytest.raises(TypeError, match="whole numbers"):
        untangle_motion(body, pose, contacts=np.array([[0.0, 1.0]]))
    with pytest.raises(ValueError, match="contacts must be 'found'"):
        untangle_motion(body, pose, contacts="near")
    with pytest.raises(ValueError, match="must name triangles"):
        untangle_motion(body, pose, contacts=[([0], [10**6])])


def test_patches_and_parts_are_tied_by_their_nearest_vertices():
    body, pose = tongs(), snap()
    frames = as_frames(body, pose, None, None)
    patches = [tuple(np.flatnonzero(body.part_groups == k) for k in (1, 2))]
    hit = np.arange(len(pose)) == 20
    asked = [as_motion_contacts(contacts, body, 1) for contacts in (patches, "found")]
    both = [kept_contacts(body, frames, x, 0.08, body.rest_surface, hit, 4) for x in asked]
    for pairs, touching in both:
        np.testing.assert_array_equal(np.flatnonzero(touching[:, 0]), np.arange(16, 25))
        near = skin(body, pose)[16:25]
        arms = [np.unique(body.faces[patch]) for patch in patches[0]]
        apart = np.linalg.norm(near[:, arms[0]][:, :, None] - near[:, arms[1]][:, None], axis=-1)
        at = np.unravel_index(apart.argmin(), apart.shape)[1:]
        assert pairs.tolist() == [[arms[0][at[0]], arms[1][at[1]]]] and touching.shape[1] == 1


@pytest.mark.long
def test_contact_that_is_found_is_kept():
    body, pose = tongs(), snap()
    arms = [np.unique(body.faces[body.part_groups == k]) for k in (1, 2)]
    change = []
    for contacts in (None, "found"):
        result = untangle_motion(body, pose, feet=0.0, contacts=contacts, contact_distance=0.08)
        assert result.is_free.all()
        gaps = []
        for posed in (skin(body, pose), skin(body, result.pose)):
            apart = posed[:, arms[0]][:, :, None] - posed[:, arms[1]][:, None]
            gaps.append(np.linalg.norm(apart, axis=-1).min(axis=(1, 2)))
        change.append(np.abs(gaps[1] - gaps[0])[gaps[0] < 0.08].max())
    assert change[1] < 0.4 * change[0]  # 44 mm and 16
