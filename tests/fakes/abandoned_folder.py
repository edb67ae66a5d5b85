"""A temporary folder that is left as it is, as after kill -9."""

import tempfile


class AbandonedFolder:
    """Takes the place of `tempfile.TemporaryDirectory`."""

    def __init__(self, *, prefix, dir):
        self._options = {"prefix": prefix, "dir": dir}

    def __enter__(self):
        return tempfile.mkdtemp(**self._options)

    def __exit__(self, *exception):
        pass
