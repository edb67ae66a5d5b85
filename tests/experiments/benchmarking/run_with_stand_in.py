"""Runs `experiments.benchmark` with the stand-in for its commands, in a process to be killed."""

from experiments import benchmark
from experiments.cli import app, subprocesses
from tests.experiments.benchmarking.conftest import stand_in_line

if __name__ == "__main__":
    subprocesses.command_line = stand_in_line
    app.run(benchmark.main)
