"""Start a worker, say its number, and be killed."""

import os
import signal

from spt_jax import config, worker, workers
from spt_jax.penalty import _value_on_host

workers._WORTH_STARTING = 0.0
config.processes = 1
pool = workers.Workers()
assert pool._ready(worker.packed(_value_on_host, None), 1) == []  # starts one
print(pool._free[0]._process.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
