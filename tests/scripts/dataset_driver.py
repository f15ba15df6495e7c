"""A run of a cheap task, to be killed: FOLDER OUT LOG SECONDS PROCESSES."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from helpers_datasets import Upper

from spt_jax.datasets import run

if __name__ == "__main__":
    folder, out, log, seconds, processes = sys.argv[1:]
    task = Upper(float(seconds), log=log)
    found = run(task, folder, out, processes=int(processes))
    print(found.by_status)
