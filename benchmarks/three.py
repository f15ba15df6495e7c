"""Rigs in three.js: `python -m benchmarks.three --modules FOLDER [--record]`.

FOLDER is one where `npm install three` was run; it wants `node`. A motion of the embedded body is
written as a rig, freed from the command line, and its animations are played by three.js' own loader
and mixer; where vertices are is compared with `load_rig`. three.js reads one set of four weights a
vertex, so a body of up to eight is shown a little off, and one of four as it is.
"""

import json
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.common import Table, provenance, record_section
from spt_jax import load_body, load_mocap, load_rig
from spt_jax.cli.main import main as command
from spt_jax.io import write_rig

# Of each animation the positions of all vertices at its start, middle and end.
_PLAY = """
import fs from 'fs';
const [modules, file] = process.argv.slice(2);
const THREE = await import(modules + '/three/build/three.module.js');
const {GLTFLoader} = await import(modules + '/three/examples/jsm/loaders/GLTFLoader.js');
globalThis.self = globalThis;
const bytes = fs.readFileSync(file);
const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const gltf = await new GLTFLoader().parseAsync(buffer, '');
let mesh; gltf.scene.traverse(o => { if (o.isSkinnedMesh) mesh = o; });
const count = mesh.geometry.attributes.position.count, point = new THREE.Vector3(), found = {};
for (const clip of gltf.animations) {
  const mixer = new THREE.AnimationMixer(gltf.scene);
  mixer.clipAction(clip).play();
  // The very end is the start of the next round.
  found[clip.name] = [0, clip.duration / 2, clip.duration * 0.999999].map(time => {
    mixer.setTime(time); gltf.scene.updateMatrixWorld(true); mesh.skeleton.update();
    const rows = [];
    for (let k = 0; k < count; k += 1) {
      mesh.getVertexPosition(k, point).applyMatrix4(mesh.matrixWorld);
      rows.push(point.toArray());
    }
    return rows;
  });
  mixer.stopAllAction(); mixer.uncacheRoot(gltf.scene);
}
console.log(JSON.stringify({revision: THREE.REVISION, found}));
"""


@dataclass
class Settings:
    """What is run."""

    modules: Path
    """A folder with node_modules/three."""
    record: bool = False
    """Put the table into results.md."""


def played(file: Path, modules: Path) -> tuple[str, dict[str, np.ndarray]]:
    """three.js' revision, and what it shows of each animation."""
    script = file.with_name("play.mjs")
    script.write_text(_PLAY)
    words = ["node", str(script), str(modules.resolve() / "node_modules"), str(file)]
    text = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    found = json.loads(text)
    return found["revision"], {name: np.array(rows) for name, rows in found["found"].items()}


def apart(file: Path, shown: dict[str, np.ndarray]) -> list[tuple[str, float]]:
    """Of each animation the farthest distance of a vertex from ours, in metres."""
    rig, found = load_rig(file), []
    assert tuple(shown) == rig.animations
    for name, rows in shown.items():
        clip = rig.clip(name)
        frames = [0, len(clip.pose) // 2, len(clip.pose) - 1]
        given = [
            np.asarray(x[frames], np.float32) for x in (clip.pose, clip.shape, clip.translation)
        ]
        vertices = np.asarray(rig.body(*given).vertices)[:, rig.rows]
        found.append((name, float(np.linalg.norm(vertices - rows, axis=-1).max())))
    return found


def main(settings: Settings) -> None:
    """Write, free, play, compare, and record where that is asked for."""
    body, mocap = load_body(num_shape=0), load_mocap()
    weights = np.array(body.weights)
    weights[np.arange(len(weights))[:, None], np.argsort(weights, axis=1)[:, :-4]] = 0
    weights /= weights.sum(axis=1, keepdims=True)
    four = body.replaced({"weights": jnp.asarray(weights)})
    names = [f"cartwheel/{k:04d}" for k in (101, 102, 103)]
    pose = body.pose_from_smpl(mocap.pose[[mocap.names.index(name) for name in names]])
    rows, revision = [], ""
    with tempfile.TemporaryDirectory() as name:
        for title, one in (("up to 8", body), ("up to 4", four)):
            folder = Path(name) / title.split()[-1]
            folder.mkdir()
            write_rig(folder / "hero.glb", one, pose, name="Cartwheel")
            words = [str(folder / "hero.glb"), "--out", str(folder), "--quiet"]
            assert command(["untangle", *words]) == 0
            file = folder / "hero_untangled.glb"
            revision, shown = played(file, settings.modules)
            rows += [(title, what, f"{1e3 * far:.4f} mm") for what, far in apart(file, shown)]
    header = ("weights a vertex", "animation", "farthest vertex from ours")
    table = Table(f"What three.js r{revision} shows", header, rows)
    table.print()
    if settings.record:
        text = (__doc__ or "").split("\n\n", 1)[1]
        parts = [provenance("python -m benchmarks.three --modules FOLDER --record"), text]
        record_section("three", "Rigs in three.js", "\n\n".join([*parts, table.markdown()]))


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
