"""The earlier tree's side of `benchmarks.folds`: volumes with folds left out, of files of meshes.

It imports the tree that it is given, not its own, and uses nothing but the public API.
"""

import inspect
import json
import sys
import time
from typing import Any

import numpy as np

sys.path.insert(0, sys.argv[1])

import spt_jax


def main() -> None:
    """Answer each line of standard input, an .npz file, with [volumes, seconds a mesh]."""
    if not str(spt_jax.__file__).startswith(sys.argv[1]):
        sys.exit(f"spt_jax must be imported from {sys.argv[1]}: got {spt_jax.__file__}.")
    body = spt_jax.load_body()
    faces, rest = np.asarray(body.faces), body.rest_surface
    # Before its first release, the argument had the name of the policy.
    names = inspect.signature(spt_jax.intersection_report).parameters
    asked: dict[str, Any] = {"rest_surface" if "rest_surface" in names else "folds": rest}
    spt_jax.intersection_report(np.asarray(body.template), faces, **asked)
    for line in sys.stdin:
        meshes = np.load(line.strip())["vertices"]
        start = time.perf_counter()
        found = [spt_jax.intersection_report(v, faces, **asked).volume for v in meshes]
        taken = (time.perf_counter() - start) / len(meshes)
        print(json.dumps([[float(volume) for volume in found], taken]), flush=True)


if __name__ == "__main__":
    main()
