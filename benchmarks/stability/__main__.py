"""Claim: light paths stay exact at the extremes of angles, indices, scales, meshes and rays.

    python -m benchmarks.stability [--density=N] [--slow]

Prints the table of docs/stability.md, and asserts every bound in it. The tests do the same on a
coarser lattice.
"""

import time

from absl import app, flags

from benchmarks.stability.measures import MEASURES

_DENSITY = flags.DEFINE_integer("density", 3, "Density of the lattices; the tests use 1.")
_SLOW = flags.DEFINE_bool("slow", False, "Also a mesh of a million triangles.")


def main(arguments: list[str]) -> None:
    del arguments
    print("| what | worst error | in | bound | cases | s |")
    print("|---|---|---|---|---|---|")
    beyond = []
    for measure in MEASURES:
        if measure.slow and not _SLOW.value:
            continue
        begin = time.perf_counter()
        found = measure.run(_DENSITY.value)
        seconds = time.perf_counter() - begin
        print(
            f"| {measure.name} | {found.worst:.1e} | {measure.unit} | {measure.bound:.0e} "
            f"| {found.cases} | {seconds:.0f} |",
            flush=True,
        )
        if not found.worst <= measure.bound:
            beyond.append(measure.name)
    assert not beyond, f"beyond their bounds: {', '.join(beyond)}"


if __name__ == "__main__":
    app.run(main)
