"""What the device path costs where no device is at hand: `python -m benchmarks.device_cost`.

Operations, bytes and memory by XLA's own count of the compiled program, and whether that program
ever returns to the host. Nothing is run but the compiler. Of loops XLA counts one round.
"""

import re
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from spt_jax import load_body, self_intersection_penalty

_TO_THE_HOST = r"callback|infeed|outfeed|\bsend\b|\brecv\b"
_ROOM = 4e9  # bytes that a batch may take


@dataclass
class Settings:
    """How many bodies."""

    counts: tuple[int, ...] = (1, 64)
    record: bool = False
    """Write the table into results.md."""


def _row(count: int) -> tuple[str, ...]:
    body = load_body()
    shape = (count, body.num_vertices, 3) if count > 1 else (body.num_vertices, 3)

    def loss(vertices):
        return jnp.sum(self_intersection_penalty(vertices, body.faces, backend="xla"))

    both = jax.jit(jax.value_and_grad(loss)).lower(jax.ShapeDtypeStruct(shape, jnp.float32))
    compiled = both.compile()
    memory, cost = compiled.memory_analysis(), compiled.cost_analysis() or {}
    assert memory is not None
    taken = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    return (
        str(count),
        f"{cost.get('flops', 0) / 1e9:.2f}",
        f"{cost.get('bytes accessed', 0) / 1e9:.2f}",
        f"{taken / 1e9:.2f}",
        "yes" if taken <= _ROOM else "no",
        str(len(re.findall(_TO_THE_HOST, compiled.as_text() or ""))),
    )


def main(settings: Settings) -> None:
    """Compile, print, record."""
    rows = []
    with progress() as bar:
        task = bar.add_task("compiling", total=len(settings.counts))
        for count in settings.counts:
            rows.append(_row(count))
            bar.advance(task)
    header = (
        "bodies",
        "operations of a round, 1e9",
        "bytes of a round, 1e9",
        "memory, GB",
        f"at most {_ROOM / 1e9:.0f} GB",
        "returns to the host",
    )
    device = jax.devices()[0]
    table = Table(
        f"Value and gradient of the embedded body by rays on the device, compiled for "
        f"{device.platform}",
        header,
        rows,
    )
    table.print()
    if settings.record:
        text = provenance("python -m benchmarks.device_cost --record")
        record_section("device-cost", "The device path, compiled", f"{text}\n\n{table.markdown()}")


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
