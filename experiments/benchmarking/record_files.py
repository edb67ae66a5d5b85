"""The results of a benchmark's jobs, each one JSON file.

Tables are made of these files alone. A job's folder can be copied to another machine's benchmark
of the same settings, to merge what both have measured: so each is compared with what the benchmark
asks for when it is read.
"""

import json
from pathlib import Path

from experiments.benchmarking import jobs, record_json, records, settings
from experiments.benchmarking.methods import METHODS, RECONSTRUCTION
from experiments.benchmarking.records import Record
from experiments.benchmarking.settings import Benchmark

_TAKE_OUT = "Take its folder out, and repeat the command."


def write(folder: Path, record: Record) -> None:
    """Writes the result of a job, all or nothing."""
    settings.write_json(folder / jobs.RESULT, record_json.to_json(record))


def read(path: Path) -> Record:
    """Reads the result of a job.

    Raises:
      ValueError: if it is none.
    """
    try:
        return record_json.from_json(json.loads(path.read_text("utf-8")))
    except ValueError as error:
        raise ValueError(
            f"{path} is not the result of a job ({error}). Remove it, and repeat the command."
        ) from error


def read_all(out: Path, benchmark: Benchmark) -> list[Record]:
    """Reads all results of a benchmark, ordered by scene and method.

    Raises:
      ValueError: if one is broken, lies in another's folder, or was made with other settings, with
        a method that is another or not known, or of another scene of that name.
    """
    found: list[Record] = []
    fingerprints = {name: scene.fingerprint for name, scene in benchmark.scenes.items()}
    for path in sorted((out / jobs.FOLDER).glob(f"*/*/{jobs.RESULT}")):
        record = read(path)
        if (record.scene, record.method) != (path.parts[-3], path.parts[-2]):
            raise ValueError(
                f"{path} is the result of {record.scene}/{record.method}. Move its folder there."
            )
        _check_method(path, record, benchmark)
        _check_scene(path, record, fingerprints.setdefault(record.scene, record.fingerprint))
        found.append(record)
    return found


def _check_method(path: Path, record: Record, benchmark: Benchmark) -> None:
    """Refuses a result that was not made as the benchmark has it."""
    if record.settings != benchmark.settings:
        raise ValueError(
            f"{path} was made with other settings than those of {path.parents[3] / settings.FILE}, "
            f"so that it does not compare. {_TAKE_OUT}"
        )
    if record.method not in (*METHODS, RECONSTRUCTION):
        raise ValueError(
            f"{path} is of the method {record.method}, which this version does not know. Use the "
            "version that made it, or take its folder out."
        )
    train = benchmark.methods.get(record.method)
    if train is None and record.method in METHODS:
        train = METHODS[record.method].train
    expected = jobs.options(record.method, train or (), benchmark.settings)
    for command in sorted({*expected, *record.options}):
        made, asked = record.options.get(command, []), expected.get(command, [])
        if made != asked:
            raise ValueError(
                f"{path} was made by {command} {' '.join(made)}, and here {record.method} is "
                f"{command} {' '.join(asked)}. {_TAKE_OUT}"
            )


def _check_scene(path: Path, record: Record, fingerprint: str) -> None:
    """Refuses a result of another scene than that of its name."""
    if record.fingerprint != fingerprint:
        raise ValueError(
            f"{path} is of another scene named {record.scene} (fingerprint {record.fingerprint}) "
            f"than the benchmark's ({fingerprint}): cameras, meshes, scene.json or images differ. "
            f"{_TAKE_OUT}"
        )
    kind = records.category_and_background(record.scene)
    if (record.category, record.background) != kind:
        raise ValueError(
            f"{path} says that {record.scene} is {record.category} before {record.background}, its "
            f"name says {' before '.join(kind)}. {_TAKE_OUT}"
        )
