"""Rendering: from light paths to colours. The library's public surface.

model = render.load_model("runs/demo")
rays = render.Rays(origins, directions, radii)
picture = render.render_image(model, rays)        # chunked and jitted
seen = render.render_rays(model, rays)            # one pure function, jit it yourself

Any function of one ray may stand in for the fields, such as a background that is known:

radiance = render.radiance_of(background)         # or radiance(origin, direction) -> linear rgb
seen = render.render_known(geometry, radiance, rays, budget=render.BUDGETS["tree"])
"""

from refref_jax.geometry.rays import Rays as Rays
from refref_jax.optics.budgets import BUDGETS as BUDGETS
from refref_jax.optics.budgets import Budget as Budget
from refref_jax.render.backgrounds import radiance_of as radiance_of
from refref_jax.render.config import ModelConfig as ModelConfig
from refref_jax.render.images import Rendering as Rendering
from refref_jax.render.images import render_image as render_image
from refref_jax.render.images import render_rays as render_rays
from refref_jax.render.known import KnownRendering as KnownRendering
from refref_jax.render.known import render_known as render_known
from refref_jax.render.model import Model as Model
from refref_jax.render.model import Params as Params
from refref_jax.render.model import init_params as init_params
from refref_jax.render.saved import load_model as load_model
