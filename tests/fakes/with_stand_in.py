"""Runs `experiments.benchmark` with stand-ins for its commands: once, with the options given.

With none it runs again and again, as starting takes seconds. It reads lines of JSON,
`{"words": [...], "environment": {...}}`, and answers each with one line,
`{"status": 0, "stdout": "...", "stderr": "..."}`.
"""

import contextlib
import io
import json
import os
import sys

from absl import flags

from experiments import benchmark
from experiments.cli import app
from experiments.runs import subprocesses
from tests.fakes.job_commands import stand_in_line


def _answer(request):
    os.environ.update(request["environment"])
    for name in flags.FLAGS:
        flags.FLAGS[name].unparse()
    out, err, status = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            app.parse(["benchmark", *request["words"]])
            benchmark.main()
        except SystemExit as end:
            status = end.code
        except (ValueError, OSError) as error:  # as `app.run` has it
            print(f"error: {error}", file=sys.stderr)
            status = 2
    return {"status": status, "stdout": out.getvalue(), "stderr": err.getvalue()}


if __name__ == "__main__":
    subprocesses.command_line = stand_in_line
    if sys.argv[1:]:
        app.run(benchmark.main)
    else:
        for line in sys.stdin:
            print(json.dumps(_answer(json.loads(line))), flush=True)
