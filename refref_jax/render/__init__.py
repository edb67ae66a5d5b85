"""Rendering of light paths to colours. Objects, rays and paths are in `refref_jax`.

`load_model` reads a trained run; `render_camera` renders it from a camera and `render_image` along
any rays, both in tiles on the host; `render_rays` is one pure function. Instead of fields, any
function of one ray can be rendered, `radiance(origin, direction)` to linear RGB, such as a
background (`radiance_of`): `render_known` renders it in tiles, and `shade` is the pure function.
`docs/library.md` shows examples of all of them.
"""

from refref_jax.geometry.rays import Rays as Rays
from refref_jax.optics.path_settings import PATH_PRESETS as PATH_PRESETS
from refref_jax.optics.path_settings import PathSettings as PathSettings
from refref_jax.render.background_rendering import KnownImage as KnownImage
from refref_jax.render.background_rendering import KnownRendering as KnownRendering
from refref_jax.render.background_rendering import render_known as render_known
from refref_jax.render.background_rendering import render_known_camera as render_known_camera
from refref_jax.render.backgrounds import CubeBackground as CubeBackground
from refref_jax.render.backgrounds import Environment as Environment
from refref_jax.render.backgrounds import LinearTexture as LinearTexture
from refref_jax.render.backgrounds import SphereBackground as SphereBackground
from refref_jax.render.backgrounds import SrgbTexture as SrgbTexture
from refref_jax.render.backgrounds import radiance_of as radiance_of
from refref_jax.render.backgrounds import shade as shade
from refref_jax.render.checkpoint_io import load_model as load_model
from refref_jax.render.images import Rendering as Rendering
from refref_jax.render.images import render_camera as render_camera
from refref_jax.render.images import render_image as render_image
from refref_jax.render.model import Model as Model
from refref_jax.render.model import ModelConfig as ModelConfig
from refref_jax.render.model import Params as Params
from refref_jax.render.model import init_params as init_params
from refref_jax.render.pixels import render_ray as render_ray
from refref_jax.render.pixels import render_rays as render_rays
