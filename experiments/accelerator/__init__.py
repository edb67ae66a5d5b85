"""Checks of an accelerator against the CPU of the same machine, for `accelerator_check`."""
