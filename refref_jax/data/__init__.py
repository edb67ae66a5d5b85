"""Scenes on disk: images, cameras, meshes. NumPy only, without a device."""


class SceneError(ValueError):
    """A file of a scene is missing, broken or contradicts another.

    The message names the file and the remedy.
    """
