"""Options of commands that render views of scenes whose background is known."""

from experiments.cli import options

RAYS_PER_PIXEL = options.rays_per_pixel(9)
SPLIT = options.split("Views to render.")
