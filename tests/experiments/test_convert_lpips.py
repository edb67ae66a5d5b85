"""Weights are converted as they are published: by PyTorch, by a stand-in, and without it."""

import pickle
import sys
import types

import numpy as np
import pytest
from absl import flags

from experiments import convert_lpips
from refref_jax import metrics
from tests.factories import made_lpips
from tests.processes.command import run_command

pytestmark = pytest.mark.loose

# The options of a command that is imported must not meet those of another.
for _flag in list(flags.FLAGS.flags_by_module_dict()[convert_lpips.__name__]):
    delattr(flags.FLAGS, _flag.name)


class _Tensor:
    def __init__(self, values):
        self._values = values

    def detach(self):
        return self

    def numpy(self):
        return self._values


@pytest.fixture
def stand_in(monkeypatch):
    """Puts something in PyTorch's place; it loads what `answer` is set to."""
    torch = types.ModuleType("torch")
    torch.Tensor, torch.calls = _Tensor, []

    def load(path, **options):
        torch.calls.append((path, options))
        if isinstance(torch.answer, Exception):
            raise torch.answer
        return torch.answer

    torch.load = load
    monkeypatch.setitem(sys.modules, "torch", torch)
    return torch


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "weights.pth"
    path.write_bytes(b"of another program")
    return path


def test_tensors_become_arrays_and_nothing_is_executed(stand_in, path):
    values = np.arange(3.0)
    stand_in.answer = {"features.0.bias": _Tensor(values), "epoch": 3}
    found = convert_lpips.read_state_dict(path)
    assert list(found) == ["features.0.bias"] and found["features.0.bias"] is values
    assert stand_in.calls == [(path, {"map_location": "cpu", "weights_only": True})]


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ([1, 2], "it is not a dict"),
        (pickle.UnpicklingError("Weights only load failed"), "more than tensors"),
        (RuntimeError("broken archive"), "broken archive"),
    ],
)
def test_what_holds_no_weights_is_named(stand_in, path, answer, message):
    stand_in.answer = answer
    with pytest.raises(ValueError, match=message) as raised:
        convert_lpips.read_state_dict(path)
    assert str(path) in str(raised.value)


def test_without_pytorch_it_is_said_what_to_do(monkeypatch, path):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ValueError, match=r"pip install torch\), or give the same arrays as \.npz"):
        convert_lpips.read_state_dict(path)
    with pytest.raises(ValueError, match="does not exist"):
        convert_lpips.read_state_dict(path.with_name("nowhere.pth"))


def test_the_command_makes_a_file_that_lpips_reads(tmp_path):
    alexnet, linear = made_lpips.state_dicts()
    np.savez(tmp_path / "a.npz", **alexnet, **{"classifier.1.bias": np.zeros(4)})
    np.savez(tmp_path / "l.npz", **linear)
    out = tmp_path / "new" / "lpips.npz"
    options = (f"--alexnet={tmp_path / 'a.npz'}", f"--lpips={tmp_path / 'l.npz'}", f"--out={out}")
    assert str(out) in run_command("convert_lpips", *options).stdout
    found = metrics.load_lpips(out)
    np.testing.assert_array_equal(found.kernels[4], alexnet["features.10.weight"])
    np.testing.assert_array_equal(found.channels[0], linear["lin0.model.1.weight"].reshape(-1))
    with np.load(out) as file:
        assert set(file.files) == {*alexnet, *linear}
    content = out.read_bytes()
    refused = run_command("convert_lpips", *options, fails=True)
    assert "exists" in refused.stderr and out.read_bytes() == content
    swapped = (f"--alexnet={tmp_path / 'l.npz'}", *options[1:2], f"--out={tmp_path / 'b.npz'}")
    wrong = run_command("convert_lpips", *swapped, fails=True)
    assert "l.npz has no features.0.weight; it has lin0.model.1.weight" in wrong.stderr
    assert "Traceback" not in wrong.stderr and not (tmp_path / "b.npz").exists()
