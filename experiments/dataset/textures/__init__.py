"""Procedural images for backgrounds, the same on every machine.

`faces` lists the pictures of cube walls and `spheres` those around a sphere. They are made of
random fields (`fields`, `sphere_fields`), cells (`cells`), stamps (`stamps`) and polygons (Pillow),
and lit as reliefs (`shading`).
"""
