"""Several browsers at once: two that work, one that stays away, one that floods."""

import itertools

import numpy as np
import pytest
import trimesh

pytest.importorskip("viser", reason="the live view needs viser")

from helpers_body import ball_arrays
from helpers_view import SECONDS, Browser, served, socket_that_never_reads, unsent_bytes, wait_until

_SLIDER = "z (degrees)"


@pytest.fixture(scope="module")
def ball_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("clients") / "balls.npz"
    np.savez(path, **ball_arrays(subdivisions=2))
    return path


@pytest.fixture(scope="module")
def view(ball_file):
    with served(ball_file, patience=2.0) as running:
        yield running


def degrees(view):
    return float(np.degrees(view.scene.pose[view.panel.joint, 2]))


def buffered(view):
    return len(view.server._websock_server._broadcast_buffer.message_from_id)


def connections(view):
    return len(view.server._websock_server._live_connections)


def test_two_browsers_see_what_either_does_and_one_may_leave(view):
    with Browser(view) as first:
        with Browser(view) as second:
            first.set(_SLIDER, 40.0)
            second.wait_for_value(_SLIDER, 40.0)
            second.set(_SLIDER, -25.0)
            first.wait_for_value(_SLIDER, -25.0)
            wait_until(lambda: abs(degrees(view) + 25.0) < 1e-3)
        wait_until(lambda: connections(view) == 1)
        first.set(_SLIDER, 10.0)
        wait_until(lambda: abs(degrees(view) - 10.0) < 1e-3)
    wait_until(lambda: connections(view) == 0 and not view.server.get_clients())


def test_a_browser_that_stays_away_holds_nobody_up_and_is_let_go(view):
    values = itertools.count(1)

    def move(browser):
        value = next(values) / 4.0
        browser.set(_SLIDER, value)
        wait_until(lambda: abs(degrees(view) - value) < 1e-3)

    with Browser(view) as other, socket_that_never_reads(view):
        wait_until(lambda: len(view.server.get_clients()) == 2)
        move(other)
        before = buffered(view)
        wait_until(lambda: move(other) or unsent_bytes(view))
        for _ in range(20):
            move(other)
        assert buffered(view) <= before + 8  # the newest of each kind
        wait_until(lambda: connections(view) == 1)
        move(other)


def test_a_browser_that_stays_away_does_not_keep_the_view_from_ending(tmp_path):
    trimesh.creation.icosphere(subdivisions=6).export(tmp_path / "ball.ply")
    with served(tmp_path / "ball.ply") as view, socket_that_never_reads(view):

        def show_again():
            view._do("reset", "reset")
            assert view.worker.wait_until_idle(SECONDS)

        wait_until(lambda: show_again() or unsent_bytes(view))
        view.stop_serving()
        assert not view.server._websock_server._server_thread.is_alive()


def test_a_flood_of_messages_leaves_one_change_waiting(view, monkeypatch):
    most, posted, post = [0], [0], view.worker.post

    def counting(key, change):
        post(key, change)
        posted[0] += 1
        most[0] = max(most[0], len(view.worker._waiting))

    monkeypatch.setattr(view.worker, "post", counting)
    with Browser(view) as browser, Browser(view) as other:
        uuid = browser.widget(_SLIDER)
        before = buffered(view)
        for k in range(1, 2001):
            browser.send(
                {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": k % 180 + 0.5}}
            )
        wait_until(lambda: posted[0] == 2000)
        last = 2000 % 180 + 0.5
        wait_until(lambda: abs(degrees(view) - last) < 1e-3)
        other.wait_for_value(_SLIDER, last)
        assert most[0] == 1 and buffered(view) <= before + 8


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300])
def test_a_value_that_poses_no_body_is_said_and_the_next_is_taken(view, value):
    with Browser(view) as browser:
        browser.set(_SLIDER, value)
        wait_until(lambda: "must be finite" in view.panel._figures.content)
        browser.set(_SLIDER, 5.0)
        wait_until(lambda: "not measured" not in view.panel._figures.content)
        assert abs(degrees(view) - 5.0) < 1e-3
