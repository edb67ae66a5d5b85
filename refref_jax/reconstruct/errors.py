"""The one error of masks or meshes of which no body can be made."""


class ReconstructionError(ValueError):
    """Masks, a grid or a mesh hold no body, or what makes one of them is not installed.

    The message says what is wrong and what to do.
    """
