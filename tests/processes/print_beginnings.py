"""Begins many trainings in one process, without a step, and prints what each came to.

Reads the file that is named: a JSON list of lists of options, or of "copy" and two folders; prints
a JSON list of records.
"""

import contextlib
import io
import json
import shutil
import sys
from pathlib import Path

import numpy as np
from absl import flags

from experiments import train
from experiments.r3f import object_source
from refref_jax.data import scene_analysis
from refref_jax.render import checkpoint_io
from refref_jax.training import fit, run_folder
from tests.fakes import report_pictures


def _begin(options):
    if options[0] == "copy":
        shutil.copytree(*options[1:])
        return None
    for name in flags.FLAGS:
        flags.FLAGS[name].unparse()
    printed = io.StringIO()
    try:
        flags.FLAGS(["train", *options])
        run = Path(flags.FLAGS.out)
        with contextlib.redirect_stdout(printed):
            train._train(run, train.check_flags())
    except (ValueError, flags.Error) as error:
        return {"error": str(error)}
    scene = checkpoint_io.load_scene(run)
    body = object_source.read(run)
    return {
        "error": None,
        "printed": printed.getvalue(),
        "body": body and vars(body),
        "indices": run_folder.read_config(run).scene.indices,
        "reconstruction": run_folder.read_config(run).scene.reconstruction,
        "faces": len(np.unique(scene.surfaces.bvh.triangles.reshape(-1, 9), axis=0)),
        "inside": scene.interfaces.index_inside.tolist(),
    }


if __name__ == "__main__":
    # What a beginning comes to is asked, not what is learned from there. The walls of these scenes
    # show no size, and the pictures of their reports are not looked at.
    fit.train = lambda run, **where: True
    scene_analysis.fit_size_by_parallax = lambda *_, **options: None
    begun = json.loads(Path(sys.argv[1]).read_text())
    with report_pictures.left_empty():
        found = [_begin(options) for options in begun]
    json.dump(found, sys.stdout)
