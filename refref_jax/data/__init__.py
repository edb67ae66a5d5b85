"""Scenes on disk: images, cameras, meshes. NumPy only; nothing here touches a device."""
