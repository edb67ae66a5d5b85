"""Resolves many plans in one process, and prints what each came to.

Reads a JSON list of lists of options; prints a JSON list of records.
"""

import contextlib
import io
import json
import sys

from absl import flags

from experiments.runs import plans


def _resolve(options):
    for name in flags.FLAGS:
        flags.FLAGS[name].unparse()
    flags.FLAGS(["train", *options])
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            config, model, geometry = plans.plan_from_flags()
    except ValueError as error:
        return {"error": str(error)}
    return {
        "error": None,
        "printed": printed.getvalue(),
        "paths": config.paths,
        "blurs": config.loss.blurs,
        "cut": model.budget.cut,
        "bends": model.budget.bends,
        "reentry": model.budget.reentry,
        "room": model.budget.paths_per_ray,
        "interior": model.config.interior,
        "reflections": model.budget.reflections,
        "total_reflection": model.budget.total_reflection,
        "distortion_over": config.loss.distortion_over,
        "footprint": model.config.footprint,
        "learned_tints": model.config.learned_tints,
        "samples": model.config.samples,
        "proposals": [proposal.samples for proposal in model.config.proposals],
        "tint": geometry.interfaces.tint.tolist(),
        "absorption": geometry.interfaces.absorption.tolist(),
    }


if __name__ == "__main__":
    json.dump([_resolve(options) for options in json.load(sys.stdin)], sys.stdout)
