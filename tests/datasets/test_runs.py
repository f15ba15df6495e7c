"""Runs over folders: whatever ends them, no result is lost, made twice or left half-written."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from helpers_datasets import Upper, check_results, texts

from spt_jax.datasets import Finished, run
from spt_jax.datasets.items import store as stores
from spt_jax.datasets.items.inventory import as_shard
from spt_jax.datasets.items.store import Store

SCRIPTS = Path(__file__).parents[1] / "scripts"


def driver(folder, out, log, *, seconds=0.05, processes=2):
    words = [str(word) for word in (folder, out, log, seconds, processes)]
    return subprocess.Popen(
        [sys.executable, SCRIPTS / "dataset_driver.py", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def children(pid):
    """The processes that the threads of another one have started, where the system says so."""
    found = []
    for thread in Path("/proc").glob(f"{pid}/task/*/children"):
        with suppress(OSError):
            found += map(int, thread.read_text().split())
    return found


def ended_well(process):
    said, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    return said


def test_every_file_has_a_row_and_a_bad_one_ends_nothing(tmp_path):
    folder, out = tmp_path / "in", tmp_path / "out"
    names = texts(folder, special=("bad", "unknown", "fault", "killed"))
    for other in ("a.jpg", "b.jpg", "part0/.hidden.txt", "notes"):
        (folder / other).write_text("")
    events = []
    found = run(Upper(), folder, out, processes=2, on_event=events.append)
    assert found.by_status == {"done": 12, "failed": 2, "lost": 1, "unknown": 1}
    assert found.others == {".jpg": 2, "hidden": 1, "no suffix": 1}
    assert (found.files, found.missing, found.kept, found.is_whole) == (16, 0, 0, False)
    rows = {row["name"]: row for row in check_results(folder, out, names)}
    assert rows["bad.txt"]["message"] == "text must be good: got bad.txt"
    assert "ZeroDivisionError: of ours" in rows["fault.txt"]["message"]
    assert "in work" in rows["fault.txt"]["traceback"]
    assert "3 processes ended" in rows["killed.txt"]["message"]
    assert "SIGKILL" in rows["killed.txt"]["message"]
    assert {one["name"] for one in found.failures} == rows.keys() - set(names)
    finished = [event.item.name for event in events if isinstance(event, Finished)]
    assert sorted(finished) == sorted(rows) and len(events) > 20
    letters = sum(len((folder / name).read_text()) for name in names)
    assert found.figures["frames"] == letters and found.figures["mean_letters"] == 1.5
    assert found.figures["largest_letter"] == ord("h")
    assert json.loads((out / "summary.json").read_text()) == found.as_dict()
    # Neither a staged file nor anything beside the results is left.
    assert not list((out / ".spt-jax" / "staging").iterdir())
    assert {path.name for path in tmp_path.iterdir()} == {"in", "out"}


def test_what_is_done_is_not_done_again_and_what_changed_is(tmp_path):
    folder, out, log = tmp_path / "in", tmp_path / "out", tmp_path / "log"
    names = texts(folder, special=("bad",))
    task = Upper(log=log)

    def worked(**how):
        log.write_text("")
        found = run(task, folder, out, processes=0, **how)
        check_results(folder, out, names)
        assert found.kept == found.files - len(log.read_text().split())
        return log.read_text().split()

    assert len(worked()) == 13
    assert worked() == []
    assert worked(retry=True) == ["bad.txt"]
    (folder / names[0]).write_text("another text")
    assert worked() == [Path(names[0]).name]
    lost = out / Path(names[1]).with_suffix(".up")
    lost.unlink()
    assert worked() == [Path(names[1]).name]
    content = lost.read_bytes()
    lost.write_bytes(content[:-1])  # cut
    assert worked() == [Path(names[1]).name]
    lost.write_bytes(content[:-1] + b"?")  # as long as it was
    with pytest.raises(AssertionError):
        worked()
    assert worked(verify=True) == [Path(names[1]).name]
    next((out / ".spt-jax" / "rows").rglob("*.json")).write_text("{")
    assert len(worked()) == 1
    (folder / names[0]).unlink()
    (out / names[0]).with_suffix(".up").unlink()
    names = names[1:]
    assert worked() == [] and len(worked(anew=True)) == 12


def test_results_of_other_settings_are_not_mixed(tmp_path):
    folder, out = tmp_path / "in", tmp_path / "out"
    texts(folder, 2)
    run(Upper(), folder, out, processes=0)
    with pytest.raises(ValueError, match=r"made with scale 1 and not 2.*--anew"):
        run(Upper(scale=2), folder, out, processes=0)
    found = run(Upper(scale=2), folder, out, processes=0, anew=True)
    assert found.by_status == {"done": 2} and found.kept == 0


def test_faults_of_the_caller(tmp_path):
    folder, out = tmp_path / "in", tmp_path / "out"
    texts(folder, 2)
    for error, said, arguments, how in (
        (FileNotFoundError, "folder must exist", (tmp_path / "none", out), {}),
        (NotADirectoryError, "folder must be a folder", (folder / "part0/text0.txt", out), {}),
        (ValueError, "out must not be the folder", (folder, folder), {}),
        (ValueError, "nor hold it", (folder, tmp_path), {}),
        (ValueError, "shard must be i/n", (folder, out), {"shard": "2/2"}),
        (ValueError, "shard must be i/n", (folder, out), {"shard": "half"}),
        (ValueError, "processes must be", (folder, out), {"processes": -1}),
        (ValueError, "engine must be", (folder, out), {"engine": "spark"}),
    ):
        with pytest.raises(error, match=said):
            run(Upper(), *arguments, **({"processes": 0} | how))
    local = type("Local", (Upper,), {"__module__": "__main__"})
    with pytest.raises(ValueError, match="got Local, of the script that runs"):
        run(local(), folder, out, processes=1)
    with pytest.raises(RuntimeError, match="scale must not be negative"):
        run(Upper(scale=-1), folder, tmp_path / "other", processes=1)
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="out must be a folder"):
        run(Upper(), folder, tmp_path / "file", processes=0)


def test_results_may_lie_in_the_folder_of_the_data_set(tmp_path):
    names = texts(tmp_path, 3)
    out = tmp_path / "cleaned"
    for _ in range(2):
        found = run(Upper(), tmp_path, out, processes=0)
        assert found.files == 3 and not found.others
    check_results(tmp_path, out, names)


def test_links_are_followed_once(tmp_path):
    folder, out = tmp_path / "in", tmp_path / "out"
    names = texts(folder, 3)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "far.txt").write_text("far")
    (folder / "link").symlink_to(tmp_path / "elsewhere")
    (folder / "circle").symlink_to(folder)
    (folder / "nothing.txt").symlink_to(tmp_path / "missing.txt")
    found = run(Upper(), folder, out, processes=0)
    assert found.by_status == {"done": 4, "failed": 1}
    check_results(folder, out, [*names, "link/far.txt"])


def test_shards_share_the_files_and_the_last_one_sums_them_up(tmp_path):
    folder, out = tmp_path / "in", tmp_path / "out"
    names = texts(folder, 20)
    left = []
    for k in range(3):
        found = run(Upper(), folder, out, processes=0, shard=f"{k}/3")
        left.append(found.missing)
    assert left[0] < 20 and left[1] < left[0] and left[2] == 0
    check_results(folder, out, names)
    assert [as_shard("1/3").has(name) for name in names] == [
        as_shard((1, 3)).has(name) for name in names
    ]


class Reserved(Upper):
    """Writes what a run writes itself."""

    def work(self, path, out, report):
        (out / "summary.json").write_text("mine")
        return {}


def test_no_output_takes_the_place_of_the_summary(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "a.txt").write_text("text")
    found = run(Reserved(), folder, tmp_path / "out", processes=0)
    assert found.by_status == {"failed": 1} and "summary.json" in found.failures[0]["message"]
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["task"] == "upper"


@pytest.mark.parametrize("call", [0, 1, 4, 7, 20])
def test_a_full_disk_ends_a_run_that_goes_on_when_there_is_room(tmp_path, monkeypatch, call):
    """Every rename and every row's writing, one after the other, finds the disk full."""
    folder, out = tmp_path / "in", tmp_path / "out"
    names = texts(folder)
    calls = 0
    whole = os.replace

    def full(*arguments):
        nonlocal calls
        calls += 1
        if calls > call:
            raise OSError(errno.ENOSPC, "No space left on device", str(arguments[1]))
        return whole(*arguments)

    Store(out).begin({"task": "upper", "scale": 1})  # before it is full
    with monkeypatch.context() as patched:
        patched.setattr(stores.os, "replace", full)
        with pytest.raises(OSError, match=r"No space left|must have room"):
            run(Upper(), folder, out, processes=0)
    rows = list((out / ".spt-jax" / "rows").rglob("*.json"))
    assert len(rows) == call // 2
    assert not [path for path in out.rglob("*") if path.name.startswith(".text")]
    assert run(Upper(), folder, out, processes=0).kept == call // 2
    check_results(folder, out, names)


class Full(Upper):
    """A task whose output does not fit on the disk."""

    def work(self, path, out, report):
        raise OSError(errno.ENOSPC, "No space left on device", str(out / "a"))


def test_a_full_disk_seen_by_another_process(tmp_path):
    folder = tmp_path / "in"
    texts(folder, 3)
    with pytest.raises(OSError, match=r"No space left on device.*make room"):
        run(Full(), folder, tmp_path / "out", processes=1)
    assert (tmp_path / "out" / "manifest.jsonl").read_text() == ""


def test_two_runs_on_one_folder_share_it(tmp_path):
    folder, out, log = tmp_path / "in", tmp_path / "out", tmp_path / "log"
    names = texts(folder, 16)
    for one in [driver(folder, out, log, processes=1) for _ in range(2)]:
        assert ended_well(one) == "{'done': 16}\n"  # each waits for what the other is at
    check_results(folder, out, names)
    worked = log.read_text().split()
    assert len(worked) == len(set(worked)) == 16


def killed_at_random(tmp_path, times, seed):
    """Kill the driver or one of its processes again and again, each a little after it works."""
    folder, out, log = tmp_path / "in", tmp_path / "out", tmp_path / "log"
    names = texts(folder, 24)
    rng = np.random.default_rng(seed)
    log.touch()
    for _ in range(times):
        before = len(log.read_text().split())
        process = driver(folder, out, log, seconds=0.02)
        while len(log.read_text().split()) == before and process.poll() is None:
            time.sleep(0.002)
        time.sleep(rng.uniform(0, 0.1))
        workers = children(process.pid)
        if rng.uniform() < 0.5 and workers and process.poll() is None:
            os.kill(int(rng.choice(workers)), signal.SIGKILL)
            time.sleep(rng.uniform(0, 0.1))
        process.kill()
        process.communicate()
    run(Upper(log=log), folder, out, processes=0)
    check_results(folder, out, names)
    # What was being worked on when something was killed was worked on again, and nothing else.
    assert 24 <= len(log.read_text().split()) <= 24 + 4 * times
    assert not list((out / ".spt-jax" / "staging").iterdir())
    assert not [path for path in out.rglob(".*.*") if path.name != ".spt-jax"]


def test_killed_at_two_random_moments(tmp_path):
    killed_at_random(tmp_path, 2, 0)


@pytest.mark.long
def test_killed_at_twenty_random_moments(tmp_path):
    killed_at_random(tmp_path, 20, 1)


def test_processes_end_with_their_driver(tmp_path):
    folder, log = tmp_path / "in", tmp_path / "log"
    texts(folder, 4)
    log.touch()
    process = driver(folder, tmp_path / "out", log, seconds=60)
    while not log.read_text():
        time.sleep(0.01)
    workers = children(process.pid)
    process.kill()
    process.communicate()
    deadline = time.monotonic() + 20
    while any(_runs(pid) for pid in workers):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert workers or not Path("/proc/self/task").exists()


def _runs(pid):
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1][:3]
    except OSError:
        return False


@pytest.mark.long
def test_a_ray_cluster_of_two_nodes_one_of_which_is_killed(tmp_path):
    pytest.importorskip("ray")
    folder, out, log = tmp_path / "in", tmp_path / "out", tmp_path / "log"
    names = texts(folder, 24, special=("bad", "unknown"))
    done = subprocess.run(
        [sys.executable, SCRIPTS / "ray_cluster.py", folder, out, log],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert "{'done': 24, 'failed': 1, 'unknown': 1} 26 26 False" in done.stdout
    check_results(folder, out, names)
