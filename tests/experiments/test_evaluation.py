"""What commands that render and measure have in common."""

import pytest

from experiments.runs import evaluation

pytestmark = pytest.mark.loose


@pytest.mark.parametrize(
    ("count", "shown"), [(1, [0]), (3, [0, 1, 2]), (10, [0, 3, 6, 9]), (100, [0, 33, 66, 99])]
)
def test_a_comparison_shows_views_from_first_to_last(count, shown):
    assert evaluation.shown_views(count) == shown


def test_only_light_that_may_be_seen_is_warned_of(capsys):
    evaluation.warn_of_dropped(1e-3, advice="Do this.")
    assert capsys.readouterr().out == ""
    evaluation.warn_of_dropped(2e-3, advice="Do this.")
    printed = capsys.readouterr().out
    assert printed.startswith("warning: path buffer overflow: 0.2 % of the throughput was dropped")
    assert "Do this." in printed
