"""Finds the bodies of many trainings in one process, and prints what each came to.

Reads a JSON list of lists of options, the run's folder first; prints a JSON list of records.
"""

import contextlib
import io
import json
import sys
from pathlib import Path

from absl import flags

from experiments import plans, training_body


def _find(run, *options):
    for name in flags.FLAGS:
        flags.FLAGS[name].unparse()
    printed = io.StringIO()
    try:
        flags.FLAGS(["train", *options])
        with contextlib.redirect_stdout(printed):
            body = training_body.find(Path(run), resume=False)
            plan = plans.plan_from_flags(body=body)
    except ValueError as error:
        return {"error": str(error)}
    return {
        "error": None,
        "printed": printed.getvalue(),
        "body": None if body is None else body.name,
        "indices": plan.config.scene.indices,
        "faces": int((plan.geometry.surfaces.bvh.triangles != 0.0).any(axis=(1, 2)).sum()),
        "inside": plan.geometry.interfaces.index_inside.tolist(),
    }


if __name__ == "__main__":
    json.dump([_find(*case) for case in json.load(sys.stdin)], sys.stdout)
