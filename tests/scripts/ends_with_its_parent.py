"""Start a worker, say its number, and be killed."""

import os
import signal

from spt_jax import config
from spt_jax.bridge import process_pool, worker
from spt_jax.overlap.host_functions import value_on_host

process_pool._WORTH_STARTING = 0.0
config.processes = 1
pool = process_pool.Workers()
assert pool._ready(worker.packed(value_on_host, None), 1) == []  # starts one
print(pool._free[0]._process.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
