"""Rigs beside Blender: `python -m benchmarks.blender --blender PYTHON`.

PYTHON is an interpreter of Python 3.11 with the package `bpy`. Blender makes characters of 27 bones
with several meshes, materials, shape keys, seams and an action, and exports them; their vertices in
every frame are compared with ours. Then the motions are changed, written back by us, imported and
posed by Blender, and compared again. With `--validator FOLDER`, a folder where
`npm install gltf-validator` was run, Khronos' validator looks at what we wrote.

Between keys that lie far apart Blender joins the components of quaternions, where the specification
follows the shortest arc: a file of such keys is apart between them, by Blender's doing.
"""

import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import tyro
from scipy.spatial import KDTree

from benchmarks.common import Table, provenance, record_section
from spt_jax import load_body, load_mocap
from spt_jax.io import RigFile, load_rig, write_rig

_SCRIPT = Path(__file__).parent / "blender_script.py"
_VALIDATE = (
    "const v=require(process.argv[1]+'/node_modules/gltf-validator'),fs=require('fs');(async()=>{"
    "for(const f of process.argv.slice(2)){const r=await v.validateBytes(new Uint8Array("
    "fs.readFileSync(f)));console.log(r.issues.numErrors)}})()"
)


@dataclass
class Settings:
    """What is run.

    Attributes:
        blender: an interpreter with bpy.
        validator: a folder with node_modules/gltf-validator; without it that is left out.
        files: other rigs with an animation, which Blender poses as they are.
        record: write the table into benchmarks/results.md.
    """

    blender: Path
    validator: Path | None = None
    files: list[Path] = field(default_factory=list)
    record: bool = False


def main(settings: Settings) -> None:
    """Make, compare, change, compare again."""
    rows: list[tuple[str, ...]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        blender(settings, "make", folder)
        changed = []
        for path in sorted(folder.glob("made_*.glb")):
            rig = load_rig(path, scale=1.0)
            found = compared(rig, rig.animations[0], path.with_suffix(".npz"))
            rows.append((path.stem, *found))
            changed.append(turned_on(rig, folder / f"{path.stem}_back.glb"))
        changed.append(embedded(folder / "embedded.glb"))
        given = []
        for file in settings.files:
            given.append(folder / f"given_{len(given)}{file.suffix}")
            given[-1].write_bytes(file.read_bytes())
            for beside in file.parent.glob("*.bin"):
                (folder / beside.name).write_bytes(beside.read_bytes())
        given = [(path, load_rig(path, scale=1.0).animations[0]) for path in given]
        both = [*changed, *given]
        blender(settings, "pose", folder, *(f"{path}={_named(name)}" for path, name in both))
        for (path, animation), title in zip(
            both, [*(p.stem for p, _ in changed), *(f.stem for f in settings.files)], strict=True
        ):
            rig = load_rig(path, scale=1.0)
            rows.append((title, *compared(rig, animation, path.with_suffix(".npz"))))
        lines = []
        if settings.validator is not None:
            written = [str(path) for path, _ in changed]
            script = ["node", "-e", _VALIDATE, str(settings.validator.resolve()), *written]
            errors = subprocess.run(script, check=True, capture_output=True, text=True).stdout
            lines = [f"Khronos' validator, errors in what we wrote: {' '.join(errors.split())}."]
    header = ("file", "joints", "vertices", "primitives", "frames", "apart, of its size", "load, s")
    table = Table("The largest distance of a vertex from Blender's", header, rows)
    table.print()
    print(*lines, sep="\n")
    if settings.record:
        command = "python -m benchmarks.blender --blender PYTHON --validator FOLDER"
        body = "\n\n".join(
            [provenance(command), (__doc__ or "").split("\n\n", 1)[1], table.markdown()]
        )
        record_section("blender", "Rigs beside Blender", "\n\n".join([body, *lines]))


def blender(settings: Settings, *words: object) -> None:
    """Run the script in Blender's interpreter."""
    command = [str(settings.blender), str(_SCRIPT), *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stdout[-2000:] + done.stderr[-4000:])


def compared(rig: RigFile, animation: str, recorded: Path) -> tuple[str, ...]:
    """Joints, vertices, primitives, frames, and the largest distance as a part of the size.

    Blender's vertices are in another order, and glTF has those along seams several times: of each
    of ours the nearest of Blender's, and the other way round.
    """
    start = time.process_time()
    load_rig(rig.path, scale=1.0)
    loading = time.process_time() - start
    with np.load(recorded) as there:
        times, fps, want = there["times"], float(there["fps"]), there["vertices"]
    clip = rig.clip(animation, frames_per_second=fps)
    count = min(len(times), len(clip.times))
    arrays = (jnp.asarray(x[:count]) for x in (clip.pose, clip.shape, clip.translation))
    found = np.asarray(rig.body(*arrays).vertices)
    worst = 0.0
    for ours, theirs in zip(found, want, strict=False):
        size = np.ptp(theirs, axis=0).max()
        apart = max(KDTree(theirs).query(ours)[0].max(), KDTree(ours).query(theirs)[0].max())
        worst = max(worst, apart / size)
    primitives = sum(len(mesh["primitives"]) for mesh in rig._document.items("meshes"))
    return (
        str(rig.body.num_joints),
        f"{rig.body.num_vertices:,}",
        str(primitives),
        str(count),
        f"{worst:.1e}",
        f"{loading:.2f}",
    )


def turned_on(rig: RigFile, path: Path) -> tuple[Path, str]:
    """The first animation with every joint turned on, written back."""
    clip = rig.clip(rig.animations[0], frames_per_second=24.0)
    turn = np.random.default_rng(0).normal(scale=0.2, size=clip.pose.shape)
    (name,) = rig.write(path, clip.with_pose(clip.pose + turn))
    return path, name


def _named(animation: str) -> str:
    """What Blender calls an animation; one without a name is the first."""
    return "" if animation.startswith("animation ") else animation


def embedded(path: Path) -> tuple[Path, str]:
    """The body that comes with the package, with a motion."""
    body, mocap = load_body(num_shape=2), load_mocap()
    rows = [name.startswith("cartwheel/") for name in mocap.names]
    poses = body.pose_from_smpl(mocap.pose[rows])[::6]
    write_rig(path, body, poses, frames_per_second=24.0, name="cartwheel")
    return path, "cartwheel"


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
