"""Rays, triangles and the tree that finds where they meet. It knows nothing of light."""
