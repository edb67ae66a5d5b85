"""Calls every command with wrong options and for its help, and prints what each answers.

Reads a JSON record, of each command a list of lists of words; prints one, of each command a
record: its options, whether JAX was imported, and of each list of words the status and what was
printed. Commands define options of the same names, so each has a process of its own, which is
forked from this one: importing Python's own takes longer than they do.
"""

import contextlib
import io
import json
import os
import re
import runpy
import sys
from unittest import mock

import numpy  # noqa: F401  so that it is imported once
from absl import app as absl_app
from absl import flags

from experiments.cli import app

_run = app.run


def _answer(main, settings, words):
    for name in flags.FLAGS:
        flags.FLAGS[name].unparse()
    absl_app._run_init.done = absl_app._register_and_parse_flags_with_usage.done = False
    sys.argv[1:] = words
    out, err, status = io.StringIO(), io.StringIO(), None
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            _run(main, **settings)
        except SystemExit as end:
            status = end.code
    return {"status": status, "out": out.getvalue(), "err": err.getvalue()}


def _right_value(flag):
    """Returns a value that an option takes."""
    if choices := getattr(flag.parser, "enum_values", None):
        return choices[0]
    if isinstance(flag.parser, flags.IntegerParser | flags.FloatParser):
        return 1
    endings = re.findall(r"PLY|\.npz", flag.help)
    return "x." + endings[0].strip(".").lower() if endings else "x"


def _is_required(flag):
    return any("must have a value" in (each.message or "") for each in flag.validators)


def _options(module):
    return {
        name: {
            "choices": getattr(flag.parser, "enum_values", []),
            "alias": flag.help.startswith("Alias for"),
            "required": _is_required(flag),
            "value": _right_value(flag),
            "least": getattr(flag.parser, "lower_bound", None),
        }
        for name, flag in app.flags_of(module).items()
    }


def _right(options, arguments):
    """Returns words with which a command begins."""
    required = [f"--{name}={each['value']}" for name, each in options.items() if each["required"]]
    return [*required, *("x" for _ in arguments)]


def _wrong(options, arguments):
    """Returns words with one mistake each, and what is to be told of it."""
    given = _right(options, arguments)
    longest = max(options, key=len)
    yield [f"--{longest[:-2]}{longest[-1]}=1"], f" {longest}"
    yield [*given, f"{longest}=1"], f"Did you mean --{longest}=1?"
    for name, option in options.items():
        if option["choices"]:
            yield [f"--{name}=zzz"], "value should be one of <"
        elif option["required"]:
            yield (
                [word for word in given if not word.startswith(f"--{name}=")],
                f"Flag --{name} must have a value",
            )
        if option["least"] is not None and not option["alias"]:
            yield [*given, f"--{name}={option['least'] - 1}"], f"flag --{name}="


def _interrupted(main, settings, words):
    """Returns what a command answers to Ctrl-C."""

    def stop(*arguments):
        raise KeyboardInterrupt

    stop.__module__ = main.__module__
    with mock.patch.object(os, "_exit", sys.exit):  # this process goes on
        return _answer(stop, settings, words)


def _try(command, cases):
    found = {}

    def record(main, **settings):
        module = sys.modules[main.__module__]
        options = _options(module)
        arguments = settings.get("arguments", ())
        wrong = list(_wrong(options, arguments))
        # What is defined in a module whose options nobody adopted would be taken, and not heeded.
        known = {flag.name for flag in flags.FLAGS.get_key_flags_for_module(module)}
        stray = [
            flag.name
            for name, defined in flags.FLAGS.flags_by_module_dict().items()
            if name.startswith("experiments.")
            for flag in defined
            if flag.name not in known
        ]
        found.update(
            options=options,
            settings=settings,
            documented=module.__doc__,
            stray=stray,
            help=_answer(main, settings, ["--help"]),
            wrong=[(meant, _answer(main, settings, words)) for words, meant in wrong],
            interrupted=_interrupted(main, settings, _right(options, arguments)),
            jax="jax" in sys.modules,
            cases=[_answer(main, settings, words) for words in cases],
            jax_after_cases="jax" in sys.modules,
        )

    app.run = record
    runpy.run_module(f"experiments.{command}", run_name="__main__", alter_sys=True)
    return found


def _forked(command, cases):
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.close(reading)
            with os.fdopen(writing, "w") as pipe:
                json.dump(_try(command, cases), pipe)
            status = 0
        finally:
            os._exit(status)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        text = pipe.read()
    assert os.waitpid(child, 0)[1] == 0, f"{command} ended with an error"
    return json.loads(text)


if __name__ == "__main__":
    asked = json.load(sys.stdin)
    json.dump({command: _forked(command, cases) for command, cases in asked.items()}, sys.stdout)
