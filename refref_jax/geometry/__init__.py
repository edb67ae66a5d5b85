"""Cameras, rays, triangles and the BVH that intersects them. Independent of optics."""
