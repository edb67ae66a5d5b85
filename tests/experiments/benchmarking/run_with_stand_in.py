"""Runs `experiments.benchmark` with the stand-in for its commands, in a process to be killed."""

from experiments import benchmark, child_process, commands
from tests.experiments.benchmarking.conftest import start_stand_in

if __name__ == "__main__":
    child_process.subprocess.Popen = start_stand_in
    commands.run(benchmark.main)
