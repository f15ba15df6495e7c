"""Start a worker, say its number, and be killed."""

import os
import signal

from spt_jax import config
from spt_jax._penalty import _value_on_host
from spt_jax.bridge import process_pool, worker

process_pool._WORTH_STARTING = 0.0
config.processes = 1
pool = process_pool.Workers()
assert pool._ready(worker.packed(_value_on_host, None), 1) == []  # starts one
print(pool._free[0]._process.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
