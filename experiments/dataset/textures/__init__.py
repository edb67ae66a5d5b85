"""Procedural images for backgrounds, the same on every machine.

`faces` lists the images of background cubes and `spheres` those of background spheres. They are
made of random fields (`fields`, `sphere_fields`), cells (`cells`), stamps (`stamps`) and polygons
(Pillow), and lit as reliefs (`shading`).
"""
