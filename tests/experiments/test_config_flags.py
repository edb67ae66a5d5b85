"""Flags of a training, on top of a file."""

import json
import subprocess
import sys

from refref_jax.training.config import TrainConfig
from tests.processes.command import ROOT

_PROGRAM = """
import json, sys
from absl import flags
from experiments import train
from refref_jax.training.config import TrainConfig, options_of
names = [option.name for option in options_of() if option.name not in ("scene", "reconstruction")]
flags.FLAGS(["train", "--out=x", f"--config={sys.argv[1]}", *(f"--{name}=auto" for name in names)])
config = train.training_body.asked(train._CONFIG, say=lambda line: None)
usual = TrainConfig()
kept = [name for name in names if config.get(name) != usual.get(name)]
print(json.dumps([names, kept, config.chosen, config.scene.path, "jax" in sys.modules]))
"""


def test_auto_takes_back_what_a_file_asks_for_of_all_options_but_the_folders(tmp_path):
    asked = {
        "scene": {"path": "a", "rule": "facing", "indices": [["glass", 1.4]]},
        "paths": {"name": "tree", "cut": 0.1, "bends": 7},
        "model": {"preset": "small", "field": "nerfacto", "samples": [4, 3], "dilation": 0.5},
        "losses": {"data": "charbonnier", "interlevel": 0.5, "distortion_over": "everywhere"},
        "schedule": {"steps": 7, "peak": 0.5},
        "seed": 3,
    }
    (tmp_path / "mine.json").write_text(json.dumps(asked))
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, str(tmp_path / "mine.json")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    names, kept, chosen, scene, jax = json.loads(done.stdout)
    assert {"ior", "seed", "preset", "samples_per_ray"} <= set(names) and not jax
    assert (kept, chosen, scene) == ([], ["scene"], "a")
    assert TrainConfig().override(scene="a").chosen == ("scene",)
