"""Whether a library could read rig files for us: `python -m benchmarks.gltf_readers [--record]`.

Wants `pip install pygltflib`, which nothing else here does. pygltflib, trimesh and our own reader
open the same files: a large one, one cut at a hundred places, one damaged in a dozen ways, and
one with fields that no reader needs and that a file which is written back must keep.
"""

import base64
import copy
import json
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.common import Table, provenance, record_section
from spt_jax import load_body, load_rig
from spt_jax.io import write_rig
from spt_jax.io.rigs.document import open_document

CUTS = 100
NOTE = """
Refused means an error that is meant for a reader of it, a ValueError or OSError with a text; a
KeyError or struct.error from the library's inside counts as one that is not. pygltflib's classes
check nothing: a file is decoded by `dataclasses_json` with what is missing filled in. It decodes no
accessor, so all that is checked of sizes, types and indices would stay ours; what it would take
over are the header and the URIs, some 60 lines, and of these it follows paths out of the folder.
What its classes do not name is gone from a file that it writes. trimesh reads positions and
triangles, without skins, weights, morph targets or animations. So ours stays.
"""


@dataclass
class Settings:
    """What is done with the figures."""

    record: bool = False
    """Put the tables into results.md."""


def ours(path: Path) -> None:
    """Our reader: the characters, their weights, morph targets and animations."""
    load_rig(path)


def pygltflib(path: Path) -> None:
    """pygltflib, and the bytes of each buffer that it knows of."""
    import pygltflib as library

    content = library.GLTF2().load(str(path))
    assert content is not None
    for buffer in content.buffers:
        content.get_data_from_buffer_uri(buffer.uri)


def trimesh(path: Path) -> None:
    """trimesh's scene."""
    import trimesh as library

    library.load_scene(path)


READERS: dict[str, Callable[[Path], None]] = {
    "pygltflib": pygltflib,
    "trimesh": trimesh,
    "ours": ours,
}


def verdict(reader: Callable[[Path], None], path: Path) -> str:
    """What becomes of a file: "read", "refused" or the name of another exception."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            reader(path)
        except (ValueError, OSError) as error:
            return "refused" if str(error) and not isinstance(error, KeyError) else repr(error)
        except Exception as error:
            return type(error).__name__
    return "read"


def damages() -> dict[str, Callable[[dict[str, Any]], None]]:
    """By name, what is done to the JSON of a good file."""

    def positions(tree: dict[str, Any]) -> dict[str, Any]:
        return tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]

    def skin(tree: dict[str, Any]) -> dict[str, Any]:
        return tree["skins"][0]

    return {
        "10^12 elements announced": lambda t: positions(t).update(count=10**12),
        "one element more than there is": lambda t: positions(t).update(
            count=positions(t)["count"] + 1
        ),
        "a view beyond its buffer": lambda t: t["bufferViews"][0].update(byteOffset=10**9),
        "a buffer of another file's, ../": lambda t: t["buffers"][0].update(uri="../secret.bin"),
        "a buffer at an absolute path": lambda t: t["buffers"][0].update(uri=t.pop("secret")),
        "a cycle of nodes": lambda t: t["nodes"][skin(t)["joints"][3]].update(
            children=[skin(t)["joints"][0]]
        ),
        "a joint that is no node": lambda t: skin(t)["joints"].__setitem__(1, 9999),
        "a joint that is a text": lambda t: skin(t)["joints"].__setitem__(1, "x"),
        "matrices that are missing": lambda t: skin(t).update(inverseBindMatrices=9999),
        "an extension that is required": lambda t: t.update(extensionsRequired=["EXT_unheard_of"]),
        "a rotation of zeros": lambda t: t["nodes"][skin(t)["joints"][1]].update(
            rotation=[0, 0, 0, 0]
        ),
        "nodes that are no list": lambda t: t.update(nodes={"a": 1}),
    }


def as_gltf(path: Path) -> dict[str, Any]:
    """A .glb's JSON with its one buffer in it."""
    document = open_document(path, None)
    tree = copy.deepcopy(document.tree)
    text = base64.b64encode(document.buffers[0]).decode()
    tree["buffers"][0]["uri"] = "data:application/octet-stream;base64," + text
    return tree


def damaged(folder: Path, good: Path) -> Table:
    """A dozen kinds of damage, and cuts."""
    tree = as_gltf(good)
    inside = folder / "inside"
    inside.mkdir()
    secret = folder / "secret.bin"
    secret.write_bytes(open_document(good, None).buffers[0])
    rows = []
    for name, damage in damages().items():
        changed = copy.deepcopy(tree) | {"secret": str(secret)}
        damage(changed)
        changed.pop("secret", None)
        path = inside / "damaged.gltf"
        path.write_text(json.dumps(changed))
        rows.append((name, *(verdict(reader, path) for reader in READERS.values())))
    content = good.read_bytes()
    found: dict[str, list[str]] = {name: [] for name in READERS}
    for at in np.linspace(1, len(content) - 1, CUTS).astype(int):
        path = inside / "cut.glb"
        path.write_bytes(content[:at])
        for name, reader in READERS.items():
            found[name].append(verdict(reader, path))
    counts = [
        ", ".join(f"{one.count(word)} {word}" for word in sorted(set(one)))
        for one in found.values()
    ]
    rows.append((f"cut, {CUTS} places", *counts))
    return Table("What becomes of damaged files", ("", *READERS), rows)


def kept(good: Path, folder: Path) -> Table:
    """Which unknown fields are there still after a file was read and written."""
    import pygltflib as library

    tree = as_gltf(good)
    tree["vendor"] = {"a": 1}
    tree["nodes"][0]["vendor"] = {"a": 1}
    tree["nodes"][0]["extras"] = {"a": 1}
    tree["nodes"][0]["extensions"] = {"VENDOR_thing": {"a": 1}}
    tree["extensions"] = {"VRMC_vrm": {"specVersion": "1.0"}}
    tree["animations"][0]["extras"] = {"a": 1}
    tree["animations"][0]["channels"][0]["target"]["extensions"] = {"VENDOR_thing": {"a": 1}}
    path, written = folder / "fields.gltf", folder / "fields_written.gltf"
    path.write_text(json.dumps(tree))
    content = library.GLTF2().load(str(path))
    assert content is not None
    content.save(str(written))
    again = {"pygltflib": json.loads(written.read_text())}
    rig = load_rig(path)
    rig.write(folder / "fields.glb", rig.clip(0))
    again["ours"] = open_document(folder / "fields.glb", None).tree
    places = {
        "an unknown field of the file": lambda t: t.get("vendor"),
        "an unknown field of a node": lambda t: t["nodes"][0].get("vendor"),
        "a node's extras": lambda t: t["nodes"][0].get("extras"),
        "a node's extension": lambda t: (t["nodes"][0].get("extensions") or {}).get("VENDOR_thing"),
        "the file's extension (VRM)": lambda t: (t.get("extensions") or {}).get("VRMC_vrm"),
        "an animation's extras": lambda t: t["animations"][0].get("extras"),
        "a channel's extension": lambda t: (
            t["animations"][0]["channels"][0]["target"].get("extensions") or {}
        ).get("VENDOR_thing"),
    }
    rows = [
        (name, *("kept" if place(one) else "gone" for one in again.values()))
        for name, place in places.items()
    ]
    return Table("What is still there in a file that was read and written", ("", *again), rows)


_TIMED = """
import re, sys, time, pathlib
from benchmarks.gltf_readers import READERS
small, large = map(pathlib.Path, sys.argv[2:])
reader = READERS[sys.argv[1]]
reader(small)
def peak():
    return int(re.search("VmHWM:\\s*(\\d+)", pathlib.Path("/proc/self/status").read_text())[1])
before = peak()
start = time.process_time()
reader(large)
print(time.process_time() - start, peak() - before)
"""


def price(small: Path, large: Path) -> Table:
    """Seconds and memory of a large file, each in a process of its own."""
    rows = []
    for name in READERS:
        command = [sys.executable, "-c", _TIMED, name, str(small), str(large)]
        out = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
        rows.append((name, f"{float(out[0]):.2f}", f"{float(out[1]) / 1024:,.0f}"))
    size = large.stat().st_size / 2**20
    title = f"A file of {size:.0f} MiB, after a small one; pygltflib decodes no array of it"
    return Table(title, ("", "seconds of processor", "memory, MiB"), rows)


def main(settings: Settings) -> None:
    """Make the files, read them, print the tables, and record them where that is asked for."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        body = load_body(num_shape=0)
        good = folder / "good.glb"
        write_rig(good, body, np.zeros((3, body.num_joints, 3)), name="still")
        large = folder / "large.glb"
        frames = 130_000
        turns = np.random.default_rng(0).normal(scale=0.1, size=(frames, body.num_joints, 3))
        write_rig(large, body, turns, name="long")
        tables = [damaged(folder, good), kept(good, folder), price(good, large)]
    for table in tables:
        table.print()
    if settings.record:
        text = (__doc__ or "").split("\n\n", 1)[1]
        parts = [provenance("python -m benchmarks.gltf_readers --record"), text, NOTE]
        parts += [table.markdown() for table in tables]
        record_section("gltf-readers", "Readers of glTF", "\n\n".join(parts))


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
