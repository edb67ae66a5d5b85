"""Radiance fields of scenes with glass and liquids, along the true, bent paths of light.

`import refref_jax.render` for the library's public surface. Importing touches no device.
"""

__version__ = "0.1.0"
