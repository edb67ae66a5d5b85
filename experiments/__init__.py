"""Commands that train, evaluate and render; run them as modules from the repository."""

import sys

if sys.argv[0] == "-m":  # as long as Python looks for the command that it was asked to run
    from experiments.cli import first_interrupt

    first_interrupt.take()
