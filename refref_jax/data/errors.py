"""The one error of data that can not be used."""


class SceneError(ValueError):
    """A file of a scene is missing, broken or contradicts another.

    The message names the file and says what to do.
    """
