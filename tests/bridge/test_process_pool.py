"""Other processes that measure along: the same bits, and no harm whatever becomes of them."""

import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from helpers import join, sampling, sphere

from spt_jax import config
from spt_jax.bridge import process_pool
from spt_jax.bridge import worker as module
from spt_jax.overlap.exclusions import NOTHING, Exclusions
from spt_jax.overlap.host_functions import PenaltyOptions, value_and_gradient_on_host
from spt_jax.rest.surface import RestSurface

SCRIPTS = Path(__file__).parents[1] / "scripts"
OPTIONS = PenaltyOptions("volume", "boundary", "vertex", sampling(None), NOTHING, 1e-7)

pytestmark = pytest.mark.skipif(not module.can_start(), reason="no workers on this system")


@pytest.fixture(autouse=True)
def two_cores_and_any_batch(monkeypatch):
    monkeypatch.setattr(process_pool, "usable_cores", lambda: 2)
    monkeypatch.setattr(config, "processes", "auto")
    monkeypatch.setattr(process_pool, "_WORTH_STARTING", 0.0)
    monkeypatch.setattr(process_pool, "_WORTH_SHARING", 0)


@pytest.fixture
def pool():
    pool = process_pool.Workers()
    yield pool
    pool.close()


@pytest.fixture(scope="module")
def executor():
    with ThreadPoolExecutor(2) as executor:
        yield executor


def batch(count=6):
    vertices, faces = join(sphere(), sphere(center=(1.1, 0.2, 0.1)))
    return [(vertices * (1 + 0.1 * k), faces) for k in range(count)]


def until_ready(pool, options=OPTIONS):
    """Wait for the worker, as a solver would: by asking again."""
    work = module.packed(value_and_gradient_on_host, options)
    for _ in range(2000):
        if ready := pool._ready(work, 1):
            pool._release(ready[0])
            return ready[0]
        time.sleep(0.01)
    raise TimeoutError


def count_answers(worker, monkeypatch):
    answers = []
    measure = type(worker).measure

    def counting(self, *arguments):
        answers.append(measure(self, *arguments))
        return answers[-1]

    monkeypatch.setattr(type(worker), "measure", counting)
    return answers


def check(pool, executor, meshes, options=OPTIONS):
    found = pool.measure(value_and_gradient_on_host, options, meshes, lambda: executor)
    for mesh, (value, gradient) in zip(meshes, found, strict=True):
        expected = value_and_gradient_on_host(*mesh, options)
        assert value == expected[0] > 0
        np.testing.assert_array_equal(gradient, expected[1])


def test_each_process_begins_with_the_same_meshes(pool, executor, monkeypatch):
    """Those it knows from the last call: a batch's meshes move a little from one to the next."""
    check(pool, executor, batch(2))
    worker = until_ready(pool)
    asked, measure = [], type(worker).measure

    def noting(self, work, mesh, patience):
        asked.append(mesh[0])
        return measure(self, work, mesh, patience)

    monkeypatch.setattr(type(worker), "measure", noting)
    for _ in range(3):
        meshes = batch(8)
        asked.clear()
        check(pool, executor, meshes)
        assert 0 < len(asked) < 8
        assert asked[0] is meshes[4][0]  # the first of its half


def test_same_bits_as_here_with_new_faces_and_options(pool, executor, monkeypatch):
    check(pool, executor, batch())  # while it starts, all is done here
    answers = count_answers(until_ready(pool), monkeypatch)
    check(pool, executor, batch())
    assert 0 < len(answers) < 6
    check(pool, executor, [(v, np.roll(f, 1, axis=1).copy()) for v, f in batch()])
    # Held by a lock that no other process can have: it is made anew there.
    vertices, faces = batch()[0]
    apart = vertices + np.where(np.arange(len(vertices)) < len(vertices) // 2, 0, 5)[:, None]
    rest = RestSurface(apart, faces, distance=0.01)
    folds = OPTIONS._replace(exclusions=Exclusions(rest=rest))
    until_ready(pool, folds)
    before = len(answers)
    check(pool, executor, batch(), folds)
    assert len(answers) > before
    loaded = Path(f"/proc/{pool._free[0]._process.pid}/maps")
    if loaded.exists():  # a worker has no use for JAX, and does not wait for its import
        assert "umath" in loaded.read_text() and "jaxlib" not in loaded.read_text()


@pytest.mark.slow
def test_released_workers_end_and_others_start(pool, executor):
    worker = until_ready(pool)
    pool.release()
    assert worker._process.poll() is not None and pool._free == [] and pool._number == 0
    assert until_ready(pool) is not worker
    check(pool, executor, batch())


def test_forgets_what_is_long_ago(pool, executor):
    for k in range(module._MOST_KEPT + 2):
        options = OPTIONS._replace(sampling=sampling(8 + k))
        worker = until_ready(pool, options)
    assert len(worker._known) == module._MOST_KEPT
    check(pool, executor, batch(2), options)


@pytest.mark.slow
def test_one_that_dies_is_replaced_until_too_many_are_lost(pool, executor):
    for number in range(3):
        worker = until_ready(pool)
        worker._process.kill()
        check(pool, executor, batch())
        assert worker._process.poll() is not None  # not left behind
        assert len(pool._losses) == number + 1
    check(pool, executor, batch())
    assert pool._free == []
    # Losses are not held against it for ever.
    pool._losses = deque([-1e9, *pool._losses][:3], maxlen=3)
    with pool._lock:
        pool._start()
    assert len(pool._free) == 1


@pytest.mark.slow
def test_one_that_is_stopped_is_not_waited_for_and_given_up_in_the_end(pool, executor, monkeypatch):
    """What it was asked for is done here after much longer than usual; then it is not asked."""
    worker = until_ready(pool)
    check(pool, executor, batch())  # what is usual
    assert pool._pace.patience(*kind_of(batch()[0])) < 60.0
    answers = count_answers(worker, monkeypatch)
    worker._process.send_signal(signal.SIGSTOP)
    check(pool, executor, batch())
    check(pool, executor, batch())
    assert pool._free == [worker] and worker._awaited and answers == [] and not pool._losses
    # An answer that comes late is nobody's, and the worker is as good as before.
    worker._process.send_signal(signal.SIGCONT)
    assert until_ready(pool) is worker and not worker._awaited
    check(pool, executor, batch())
    assert answers
    worker._process.send_signal(signal.SIGSTOP)
    check(pool, executor, batch())
    worker._awaited = dict.fromkeys(worker._awaited, -1e9)  # as if a minute had passed
    check(pool, executor, batch())
    assert worker._process.poll() is not None and len(pool._losses) == 1


@contextmanager
def starved(worker, runs=0.002, rests=0.06):
    """The worker gets a thirtieth of its time, as on a machine that is busy with other things."""
    ended = threading.Event()

    def take_turns():
        while not ended.wait(runs):
            worker._process.send_signal(signal.SIGSTOP)
            ended.wait(rests)
            worker._process.send_signal(signal.SIGCONT)

    thread = threading.Thread(target=take_turns)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.mark.slow
def test_one_that_is_slow_does_what_it_can_and_holds_nobody_up(pool, executor, monkeypatch):
    """It takes a mesh when it is done with its last one, so that most are measured here."""
    worker = until_ready(pool)
    check(pool, executor, batch())  # what is usual
    usual = pool._pace.patience(*kind_of(batch()[0]))
    asked = []
    measure = type(worker).measure
    monkeypatch.setattr(
        type(worker), "measure", lambda self, *given: asked.append(given) or measure(self, *given)
    )
    with starved(worker):
        for _ in range(3):
            check(pool, executor, batch(12))
        assert 1 <= len(asked) <= 18 and not pool._losses
        # Being slow is not learned as what is usual, by which its lateness is told.
        assert pool._pace.patience(*kind_of(batch()[0])) < 20 * usual
    assert until_ready(pool) is worker
    asked.clear()
    check(pool, executor, batch(12))
    assert asked and worker._process.poll() is None and not pool._losses


def test_a_single_mesh_is_not_kept_waiting_either(pool, executor, monkeypatch):
    monkeypatch.setattr(process_pool, "_WORTH_ASKING", 0)
    worker = until_ready(pool)
    check(pool, executor, batch())
    worker._process.send_signal(signal.SIGSTOP)
    pool._at_work = 1  # as if another thread were measuring
    (mesh,) = batch(1)
    value, _ = pool.measure_one(value_and_gradient_on_host, OPTIONS, mesh)
    assert value == value_and_gradient_on_host(*mesh, OPTIONS)[0]
    assert pool._free == [worker] and worker._awaited


def test_one_without_memory_is_replaced(pool, executor):
    """What it cannot do is done here."""
    resource = pytest.importorskip("resource")
    if not hasattr(resource, "prlimit"):
        pytest.skip("no limits on other processes here")
    worker = until_ready(pool)
    resource.prlimit(worker._process.pid, resource.RLIMIT_AS, (1 << 20, 1 << 20))
    vertices, faces = sphere(subdivisions=5)
    check(pool, executor, [join((vertices, faces), (vertices * s + 0.4, faces)) for s in (1, 2)])
    assert len(pool._losses) <= 1


def test_patience_is_some_times_what_is_usual():
    pace = process_pool.Pace(kinds=2)
    for _ in range(20):
        pace.note(b"body", 1000, 0.02)
    usual = pace.patience(b"body", 1000)
    assert 0.1 < usual < 0.5
    pace.note(b"body", 1000, 100.0)  # one hiccup
    assert pace.patience(b"body", 1000) < 2 * usual
    assert pace.patience(b"other", 1000) > usual
    for work in (b"one", b"two"):
        pace.note(work, 10, 1.0)
    assert len(pace._usual) == 2 and pace.patience(b"body", 1000) > 2 * usual


def kind_of(mesh):
    return module.packed(value_and_gradient_on_host, OPTIONS), len(mesh[1])


def test_errors_are_raised_here_and_leave_no_worker_busy(pool, executor):
    until_ready(pool)
    meshes = [(None, batch()[0][1]), *batch()]
    with pytest.raises(TypeError):
        pool.measure(value_and_gradient_on_host, OPTIONS, meshes, lambda: executor)
    check(pool, executor, batch())


def test_functions_that_another_process_cannot_find_stay_here(pool, executor):
    def double(vertices, faces, options):
        return (2 * vertices,)

    assert module.packed(double, None) is None
    found = pool.measure(double, None, batch(2), lambda: executor)
    np.testing.assert_array_equal(found[1][0], 2 * batch(2)[1][0])
    assert pool._free == []


def test_nothing_is_started_before_it_is_worth_it(pool, executor, monkeypatch):
    monkeypatch.setattr(process_pool, "_WORTH_STARTING", 100.0)
    check(pool, executor, batch(2))
    assert pool._free == []
    monkeypatch.setattr(process_pool, "_WORTH_STARTING", 0.0)
    monkeypatch.setattr(sys, "executable", "/usr/bin/blender")
    check(pool, executor, batch(2))
    assert pool._free == []


def test_ends_with_its_parent_even_if_that_is_killed():
    done = subprocess.run(
        [sys.executable, SCRIPTS / "ends_with_its_parent.py"], capture_output=True, timeout=60
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    pid = int(done.stdout.split()[0])
    for _ in range(1000):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        if Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z":
            return  # ended; nobody has asked for its status
        time.sleep(0.01)
    raise AssertionError("the worker is still there")


def test_a_forked_child_leaves_them_to_its_parent(pool, executor):
    worker = until_ready(pool)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # JAX and Python warn of forks in threaded processes
        child = os.fork()
    if child == 0:
        pool.leave_to_parent()
        os._exit(0 if pool._free == [] and pool._number == 0 else 1)
    assert os.waitpid(child, 0)[1] == 0
    assert worker._process.poll() is None
    check(pool, executor, batch())
    assert not pool._losses
