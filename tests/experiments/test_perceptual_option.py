"""Weights of LPIPS and the package of FLIP: used where they are there, else a warning."""

import sys

import pytest

from experiments.cli import perceptual_option
from refref_jax.training.evaluation import Perceptual
from tests import made_lpips


def test_what_is_not_at_hand_is_warned_of_once(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(perceptual_option, "LPIPS_WEIGHTS", _Flag(None))
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    assert perceptual_option.chosen() == Perceptual(None, None)
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("warning: LPIPS") and "docs/metrics.md" in first
    assert second.startswith("warning: FLIP") and "pip install -e '.[flip]'" in second
    monkeypatch.setattr(perceptual_option, "LPIPS_WEIGHTS", _Flag(str(tmp_path / "none.npz")))
    with pytest.raises(ValueError, match=r"none\.npz can not be read"):
        perceptual_option.chosen()
    weights = made_lpips.write(tmp_path / "weights.npz")
    monkeypatch.setattr(perceptual_option, "LPIPS_WEIGHTS", _Flag(str(weights)))
    assert perceptual_option.chosen().lpips is not None
    assert "LPIPS" not in capsys.readouterr().out


class _Flag:
    def __init__(self, value):
        self.value = value
