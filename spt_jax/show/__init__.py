"""Pictures of meshes and of numbers for people to look at."""

from spt_jax.show.animation import Figure as Figure
from spt_jax.show.animation import before_and_after as before_and_after
from spt_jax.show.animation import write_animation as write_animation
from spt_jax.show.arrows import render_arrows as render_arrows
from spt_jax.show.curves import plot_curves as plot_curves
from spt_jax.show.film import write_film as write_film
from spt_jax.show.overlay import render_overlay as render_overlay
from spt_jax.show.pictures import render_before_after as render_before_after
from spt_jax.show.pictures import render_mesh as render_mesh
from spt_jax.show.pictures import render_strip as render_strip
from spt_jax.show.ray_pictures import plot_ray as plot_ray
from spt_jax.show.ray_pictures import plot_rays as plot_rays
from spt_jax.show.rays import RayImages as RayImages
from spt_jax.show.rays import ray_images as ray_images
