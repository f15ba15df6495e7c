"""Triangle meshes read from and written to files."""

from spt_jax.io.meshes.arrays import as_mesh_arrays as as_mesh_arrays
from spt_jax.io.meshes.arrays import fits_single as fits_single
from spt_jax.io.meshes.arrays import single_rounding as single_rounding
from spt_jax.io.meshes.reading import MeshFile as MeshFile
from spt_jax.io.meshes.reading import open_mesh as open_mesh
from spt_jax.io.meshes.reading import read_mesh as read_mesh
from spt_jax.io.meshes.writing import BODY_COLOR as BODY_COLOR
from spt_jax.io.meshes.writing import INVERTED_COLOR as INVERTED_COLOR
from spt_jax.io.meshes.writing import PENETRATING_COLOR as PENETRATING_COLOR
from spt_jax.io.meshes.writing import write_mesh as write_mesh
from spt_jax.io.meshes.writing import write_shape as write_shape
