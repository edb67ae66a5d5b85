"""Refinement of cameras on pixels beside the object."""
