"""A cheap task over text files, to try engines with, and what must be true of its results."""

import hashlib
import json
import os
import signal
import time
from pathlib import Path

import numpy as np

from spt_jax.datasets.items.work import UnknownFileError


class Upper:
    """Writes what a file holds in capitals, and on request fails as real tasks do."""

    name = "upper"

    def __init__(self, seconds=0.0, *, log=None, scale=1, ends=()):
        self.seconds, self.log, self.scale, self.ends = seconds, log, scale, ends

    def settings(self):
        return {"scale": self.scale}

    def wants(self, path):
        return path.suffix == ".txt"

    def start(self):
        if self.scale < 0:
            raise ValueError("scale must not be negative: got one that is")

    def work(self, path, out, report):
        text = path.read_text()
        if self.log is not None:  # one line a piece of work, whoever does it
            with open(self.log, "a") as stream:
                stream.write(f"{path.name}\n")
        if text.startswith("unknown"):
            raise UnknownFileError(f"text must be known: got {path.name}")
        if text.startswith("bad"):
            (out / "half.txt").write_text("half of a result")
            raise ValueError(f"text must be good: got {path.name}")
        if text.startswith("fault"):
            raise ZeroDivisionError("of ours")
        if text.startswith("killed") or path.name in self.ends:
            os.kill(os.getpid(), signal.SIGKILL)
        report(0, 1, "shouting")
        content = self.scale * text.upper().encode()
        with open(out / f"{path.stem}.up", "wb") as stream:
            stream.write(content[: len(content) // 2])
            stream.flush()
            time.sleep(self.seconds)  # where it may be killed with half of its output written
            stream.write(content[len(content) // 2 :])
        return {"frames": len(text), "largest_letter": max(map(ord, text)), "mean_letters": 1.5}


def texts(folder: Path, count=12, *, special=()):
    """Files in folders, each with a text of its own; the names of those that can be done."""
    rng = np.random.default_rng(0)
    names = []
    for k in range(count):
        path = folder / f"part{k % 3}" / f"text{k}.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(rng.choice(list("efgh"), size=50 + 10 * k)))
        names.append(path.relative_to(folder).as_posix())
    for word in special:
        (folder / f"{word}.txt").write_text(f"{word} text")
    return names


def check_results(folder: Path, out: Path, names):
    """Every file has one row and one whole output, and nothing else lies in the results."""
    rows = [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]
    done = {row["name"]: row for row in rows if row["status"] == "done"}
    others = [row for row in rows if row["status"] != "done"]
    assert len(rows) == len({row["name"] for row in rows}) and sorted(done) == sorted(names), others
    for name, row in done.items():
        (output,) = row["outputs"]
        content = (out / output).read_bytes()
        assert content == (folder / name).read_bytes().upper()
        assert row["output_sha256"] == [hashlib.sha256(content).hexdigest()]
    expected = {output for row in done.values() for output in row["outputs"]}
    found = {
        path.relative_to(out).as_posix()
        for path in out.rglob("*")
        if path.is_file() and ".spt-jax" not in path.parts
    }
    assert found == expected | {"manifest.jsonl", "manifest.csv", "summary.json"}
    return rows
