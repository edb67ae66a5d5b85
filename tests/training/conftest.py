import functools
from pathlib import Path

import pytest

from refref_jax.training import fit, resolve


@functools.cache
def _read(scene, files):
    facts = resolve.read_facts(scene)
    return facts._replace(misfits=facts.misfits and functools.cache(facts.misfits))


@pytest.fixture(autouse=True, scope="module")
def _unchanged_scenes_are_read_once():
    """To read and check the bundled scene takes a second, and most tests prepare a run on it."""

    def read_facts(scene, *, parts=None):
        if parts is not None or scene.properties:
            return resolve.read_facts(scene, parts=parts)
        found = sorted(path for path in Path(scene.path).rglob("*") if path.is_file())
        stats = [path.stat() for path in found]
        return _read(scene, tuple((x.st_ino, x.st_size, x.st_mtime_ns) for x in stats))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "read_facts", read_facts)
        yield
