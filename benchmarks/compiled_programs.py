"""Claim: programs compiled for an H100, which need not be there, cost no more than is recorded.

    pip install 'refref_jax[aot]'           # or --packages=FOLDER with the two packages
    python -m benchmarks.compiled_programs [--programs=NAME,NAME] [--write]

Compiles what training runs (light paths of a pool of batches, steps, the product in the solver of
backdrops) for an H100 and for this CPU, each in a process of its own, and prints kernels, bytes and
temporaries by part. Counts are those of `ahead_of_time.counters`; nothing runs. A step is one
iteration of its program. Asserted is that no kernel compares and swaps, and that kernels, bytes,
temporaries, launches, the longest kernel's text and gathers in branches of a kernel are at most 2 %
above `results/compiled_programs.json`, which `--write` writes.
"""

import json
from typing import Any

from absl import app, flags

from benchmarks.ahead_of_time import hopper
from benchmarks.ahead_of_time.compile import PROGRAMS, RECORDED, TARGETS, counts_of, excess

_PROGRAMS = flags.DEFINE_list("programs", list(PROGRAMS), "Programs to compile.")
_TARGETS = flags.DEFINE_list("targets", list(TARGETS), "Targets to compile for.")
_PACKAGES = flags.DEFINE_list("packages", [], "Folders of packages with the plugin for CUDA 13.")
_WRITE = flags.DEFINE_bool("write", False, "Record these counts.")


def main(arguments: list[str]) -> None:
    del arguments
    if not _PACKAGES.value and "h100" in _TARGETS.value and (lacking := hopper.missing()):
        raise app.UsageError(f"Nothing compiles for an H100: {lacking}.")
    recorded = json.loads(RECORDED.read_text()) if RECORDED.exists() else {}
    print("program,target,part,kernels,gigabytes,temporaries", flush=True)
    wrong = []
    for name in _PROGRAMS.value:
        for target in _TARGETS.value:
            counted = counts_of(name, target, packages=_PACKAGES.value)
            print("\n".join(_rows(name, target, counted)), flush=True)
            before = recorded.setdefault(name, {}).get(target, counted)
            if target == "h100" and not _WRITE.value:
                wrong += [f"{name}: {each}" for each in excess(counted, before)]
            recorded[name][target] = counted
            if _WRITE.value:
                RECORDED.write_text(json.dumps(recorded, indent=1) + "\n")
    assert not wrong, "; ".join(wrong)


def _rows(program: str, target: str, counted: dict[str, Any]) -> list[str]:
    """Returns the lines of a program's table: all of it, then each part."""
    whole = f"{counted['kernels']},{counted['bytes'] / 1e9:.3f},{counted['temporaries'] / 1e9:.3f}"
    parts = [
        f"{program},{target},{part},{number},{size / 1e9:.3f},"
        for part, (number, size) in counted["parts"].items()
    ]
    return [f"{program},{target},all,{whole}", *parts]


if __name__ == "__main__":
    app.run(main)
