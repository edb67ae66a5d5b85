"""The fifty objects, as closed surfaces that are made, not downloaded (NumPy only)."""
