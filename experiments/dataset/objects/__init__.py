"""The fifty objects, as procedural closed surfaces (NumPy only)."""
