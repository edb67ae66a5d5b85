"""Meshes and point clouds of trained runs, for other programs."""
