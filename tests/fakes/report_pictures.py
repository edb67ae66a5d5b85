"""Empty files in place of the pictures of reports, for tests that do not look at them."""

import contextlib

import pytest

from experiments.r3f import report, report_figures


@contextlib.contextmanager
def left_empty():
    """Has reports of reconstructions write empty pictures."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("draw_overlaps", "draw_errors", "draw_surface"):
            patch.setattr(report_figures, name, lambda path, _: path.touch())
        patch.setattr(report, "_HEIGHT", 40)  # of the surfaces that are rendered for them
        yield
