"""A run on a Ray cluster of two nodes, one of which is killed: FOLDER OUT LOG."""

import os
import sys
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
os.environ["RAY_AUTH_MODE"] = "disabled"
import ray
from helpers_datasets import Upper
from ray.cluster_utils import Cluster

from spt_jax.datasets import Finished, Resources, run


def main(folder, out, log):
    cluster = Cluster()
    options = {"object_store_memory": 80 << 20, "include_dashboard": False}
    cluster.add_node(num_cpus=1, **options)
    doomed = cluster.add_node(num_cpus=1, object_store_memory=80 << 20)
    finished = []

    def kill_a_node():
        while len(finished) < 5:
            time.sleep(0.05)
        cluster.remove_node(doomed, allow_graceful=False)

    killer = threading.Thread(target=kill_a_node, daemon=True)
    killer.start()

    def on_event(event):
        if isinstance(event, Finished):
            finished.append(event.item.name)

    asked = Resources(address=cluster.address, memory=100 << 20)
    found = run(Upper(0.3, log=log), folder, out, engine="ray", ray=asked, on_event=on_event)
    killer.join(30)
    print(found.by_status, len(finished), len(set(finished)), killer.is_alive())
    cluster.shutdown()


if __name__ == "__main__":
    main(*sys.argv[1:])
    ray.shutdown()
