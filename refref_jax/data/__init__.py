"""Scenes on disk: images, cameras, meshes. NumPy only; nothing here touches a device."""


class SceneError(ValueError):
    """A file of a scene is missing, broken or contradicts another.

    The message names the file and says what to do.
    """
