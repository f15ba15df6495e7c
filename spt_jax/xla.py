"""The path in JAX alone, `backend="xla"`: the sizes of its arrays, and how much of them is used."""

from spt_jax.device.settings import Xla as Xla
from spt_jax.device.usage import device_usage as device_usage

__all__ = ["Xla", "device_usage"]
