"""What all commands have in common: help, mistakes, and that nothing is replaced unasked."""

import json
import signal
import subprocess
import sys

import pytest

from experiments.cli import choosable, command_help, command_line, commands, run_option
from experiments.cli.late_imports import late
from experiments.r3f import records
from experiments.r3f.geometry_stage import GEOMETRIES
from refref_jax.data import local_layout
from refref_jax.fields import registry
from refref_jax.optics.interface_rules import RULES
from refref_jax.training import presets, run_folder
from tests.experiments.command import ROOT

_SCRIPTS = [
    path.relative_to(ROOT / "experiments").with_suffix("")
    for path in (ROOT / "experiments").rglob("*.py")
    if "\n    commands.run(" in path.read_text("utf-8")
]
_SCENE = ROOT / "experiments" / "data" / "cube_smcvx_ball"
_COMMANDS = sorted(".".join(path.parts) for path in _SCRIPTS)

# Of commands with --overwrite: words that name FOLDER, and what is in the way there.
_IN_THE_WAY = {
    "evaluate": (["--run=FOLDER"], "eval/test/metrics.json"),
    "render": (["--run=x", "--out=FOLDER"], "rgb.gif"),
    "render_known": (["--scene=x", "--out=FOLDER"], "rgb/mine.png"),
    "path_trade_off": (["--scenes=x", "--out=FOLDER"], "path_trade_off.csv"),
    "glass_figures": (["--scene=x", "--out=FOLDER"], "glass_fan.jpg"),
    "metrics": (["x", "y", "--out=FOLDER/metrics.json"], "metrics.json"),
    "export": (["--run=x", "--what=mesh", "--out=FOLDER/a.ply"], "a.ply"),
    "convert_lpips": (["--alexnet=x", "--lpips=x", "--out=FOLDER/a.npz"], "a.npz"),
    "dataset.check": (["FOLDER"], "check.html"),
}

_OF_THE_SCENE = {
    "--cut=1": "--cut=1.0: The cut is a share of a pixel's light",
    "--bends=-1": "can not have -1 bends. Give 0 or more.",
    "--samples=4,0": "Write as in --samples=32,20.",
    "--multisamples=3": "Give 1 (on the centre line) or 6",
    "--entries=40": "Give 1 to 31",
    "--paths=straight --cut=0.1": "Leave them out, or use --paths=tree.",
    "--ior=1.5": "Write as in --ior=glass=1.52.",
    "--ior=glass=-1": "with a positive number",
    "--method=r3f --ior=glass=1.5": "Give its index alone",
    "--resolution=32": "or add --method=r3f.",
    "--resume=maybe": "Give --resume or --noresume.",
    "--steps": "--steps has no value. Give it as in --steps=VALUE.",
    "--devices=two": "Give one, or all.",
}

# What absl does not know the values of, and what is not there; of each command, with its refusal.
_MISTAKES = {
    "train": {
        "--out=OUT --scene=nowhere": "nowhere/transforms_train.json does not exist",
        "--out=OUT --scene=hf:cubebg/cube_smcvx_ball": "no configuration of the data set",
        "--out=OUT": "Add --scene=FOLDER, or --resume",
        **{f"--out=OUT --scene=SCENE {words}": told for words, told in _OF_THE_SCENE.items()},
    },
    "evaluate": {
        "--run=x --rays_per_pixel=8": "Give 4 or 9.",
        "--run=nowhere": "nowhere/config.json does not exist",
    },
    "render": {"--run=nowhere": "nowhere/config.json does not exist"},
    "render_known": {
        "--out=OUT --scene=nowhere": "nowhere/transforms_train.json does not exist",
        "--out=OUT --scene=SCENE --cut=-0.5": "Give 0.02 for 2 %.",
        "--out=OUT --scene=SCENE --ior=glass": "Write as in --ior=glass=1.52.",
        "--out=OUT --scene=SCENE --paths=straight --unfinished=dark": "none is unfinished",
        "--out=OUT --scene=SCENE --views=1,1": "names a view twice",
    },
    "path_trade_off": {
        "--out=OUT --scenes=SCENE,nowhere": "nowhere/transforms_train.json does not exist",
        "--out=OUT --scenes=SCENE --cuts=2": "Give 0.02 for 2 %.",
        "--out=OUT --scenes=SCENE --ior=glass=x": "Write as in --ior=glass=1.52.",
        "--out=OUT --scenes=SCENE --views=a": "as in --views=0,10,20",
    },
    "glass_figures": {
        "--out=OUT --scene=nowhere": "nowhere/transforms_train.json does not exist",
        "--out=OUT --scene=SCENE --ior==1.5": "Write as in --ior=glass=1.52.",
    },
    "view": {
        "--run=x --heights=2,1": "whole numbers that grow",
        "--run=nowhere": "nowhere/config.json does not exist",
    },
    "export": {
        "--run=x --what=body --out=a.obj": "ends with .ply",
        "--run=nowhere --what=mesh --out=OUT.ply": "nowhere/config.json does not exist",
        "--run=nowhere --what=body --out=OUT.ply": "nowhere/config.json does not exist",
    },
    "reconstruct": {
        "--out=OUT --scene=x --ior=0.5": "--ior=0.5 is no index",
        "--out=OUT --scene=nowhere": "nowhere/transforms_train.json does not exist",
    },
    "trade_off": {
        "--out=OUT --scene=x --steps=0,1": "Give 1 or more.",
        "--out=OUT --scene=nowhere": "nowhere/transforms_train.json does not exist",
    },
    "recommend": {"--scene=nowhere --minutes=1": "nowhere/transforms_train.json does not exist"},
    "import_masks": {
        "--out=OUT --scene=nowhere --masks=x": "nowhere/transforms_train.json does not exist"
    },
    "benchmark": {
        "--out=OUT --methods=tree,strait": "Did you mean straight?",
        "--out=OUT --scenes=SCENE,nowhere": "nowhere/transforms_train.json does not exist",
    },
    "dataset.convert": {"--scene=nowhere --to=raw --out=OUT": "nowhere is no folder."},
    "dataset.make": {"--out=OUT --scenes=cube_smcvx_bal": "Did you mean cube_smcvx_ball"},
    "dataset.check": {"x --cut=2": "Give 0.02 for 2 %.", "nowhere": "nowhere is no folder."},
    "convert_nerfstudio": {
        "--source=x --out=OUT --scale=-1": "Give a positive number",
        "--source=nowhere --out=OUT": "nowhere is no folder.",
    },
}


@pytest.fixture(scope="module")
def tried(tmp_path_factory):
    """What each command answered, and the folder that held what was in its way."""
    cases, folders = {}, {}
    out = tmp_path_factory.mktemp("mistakes") / "out"
    for command in _COMMANDS:
        cases[command] = [_words(line, out) for line in _MISTAKES.get(command, ())]
        if command in _IN_THE_WAY:
            words, name = _IN_THE_WAY[command]
            folder = folders[command] = tmp_path_factory.mktemp(command)
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text("mine")
            cases[command].append([word.replace("FOLDER", str(folder)) for word in words])
    done = subprocess.run(
        [sys.executable, "-m", "tests.experiments.print_manners"],
        input=json.dumps(cases),
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert not list(out.parent.iterdir())
    return json.loads(done.stdout), folders


def _words(line, out):
    return line.replace("OUT", str(out)).replace("SCENE", str(_SCENE)).split()


def _refusal(answer):
    """Returns the line that refuses, after checking that there is no other."""
    assert answer["status"] == 2, answer
    (line,) = answer["err"].splitlines()
    assert line.startswith("error: ")
    return line


def test_all_commands_are_found():
    assert {"train", "evaluate", "view", "dataset.make", "benchmark"} <= set(_COMMANDS)
    assert set(_IN_THE_WAY) | set(_MISTAKES) <= set(_COMMANDS)


@pytest.mark.parametrize("command", _COMMANDS)
def test_help_fits_a_screen(tried, command):
    answer = tried[0][command]
    lines = answer["help"]["out"].splitlines()
    assert answer["help"]["status"] == 0 and not answer["help"]["err"]
    assert len(lines) <= command_help.LINES
    assert max(map(len, lines)) <= command_help.WIDTH
    assert lines[0] == answer["documented"].splitlines()[0] and len(lines[0]) > 20
    assert f"python -m experiments.{command} " in answer["help"]["out"]
    # Required options come first, and every option is there or named.
    marked = [line.split()[1] for line in lines if line.startswith("* ")]
    required = [f"--{name}" for name, each in answer["options"].items() if each["required"]]
    assert marked == required
    for name in answer["options"]:
        assert f"--{name}" in answer["help"]["out"]
    assert "Given again: " in answer["help"]["out"] and answer["settings"]["again"]
    assert set(answer["settings"].get("first", ())) <= set(answer["options"])


@pytest.mark.parametrize("command", _COMMANDS)
def test_full_help_explains_every_option(tried, command):
    answer = tried[0][command]
    blocks = answer["full"]["out"].split("\n  --")[1:]
    assert [block.split(":")[0].split("\n")[0] for block in blocks] == list(answer["options"])
    for block in blocks:
        assert len(block.split("\n      ", 1)[1].strip()) > 10, block
    assert answer["full"]["status"] == 0
    for name, option in answer["options"].items():
        if option["choices"]:
            assert f"--{name}: {' or '.join(option['choices'])}" in answer["full"]["out"]


@pytest.mark.parametrize("command", _COMMANDS)
def test_mistakes_are_told_with_what_was_meant_before_jax_is_imported(tried, command):
    answer = tried[0][command]
    assert len(answer["wrong"]) >= 2
    for meant, refused in answer["wrong"]:  # and say what to do, of numbers out of range too
        assert meant in _refusal(refused)
        assert not refused["out"]
    assert not answer["jax"]


@pytest.mark.parametrize("command", _COMMANDS)
def test_a_command_tells_what_to_run_next(command):
    source = (ROOT / "experiments" / f"{command.replace('.', '/')}.py").read_text("utf-8")
    # `recommend` prints nothing else, and from where the recommendation is made.
    assert '"Next' in source or "Next, " in source or command == "recommend"


@pytest.mark.parametrize("command", _COMMANDS)
def test_an_interrupt_is_130_and_says_how_to_go_on(tried, command):
    answer = tried[0][command]
    assert answer["interrupted"]["status"] == commands.INTERRUPTED == 130
    again = answer["settings"]["again"]
    assert answer["interrupted"]["err"] == f"Interrupted. {again[0].upper()}{again[1:]}\n"


@pytest.mark.parametrize("command", _COMMANDS)
def test_no_option_is_taken_and_not_heeded(tried, command):
    assert tried[0][command]["stray"] == []


@pytest.mark.parametrize("command", sorted(_MISTAKES))
def test_wrong_values_and_what_is_not_there_are_told_before_jax_is_imported(tried, command):
    answer, mistakes = tried[0][command], _MISTAKES[command].items()
    for (line, told), refused in zip(mistakes, answer["cases"], strict=False):
        assert told in _refusal(refused), line
        assert "warning" not in refused["out"]
    assert not answer["jax_after_cases"]


@pytest.mark.parametrize("command", _COMMANDS)
def test_what_is_there_is_refused_before_anything_is_done(tried, command):
    answers, folders = tried
    assert ("overwrite" in answers[command]["options"]) == (command in _IN_THE_WAY)
    if command not in _IN_THE_WAY:
        return
    name = _IN_THE_WAY[command][1]
    refused = answers[command]["cases"][-1]
    assert name.partition("/mine")[0] in _refusal(refused) and "--out" in _refusal(refused)
    # The options that hold are told first.
    assert refused["out"].startswith(f"experiments.{command} ")
    has_defaults = any(option["default"] for option in answers[command]["options"].values())
    assert ("  by default: --" in refused["out"]) == has_defaults
    left = [path for path in folders[command].rglob("*") if path.is_file()]
    assert left == [folders[command] / name] and left[0].read_text() == "mine"
    assert not answers[command]["jax_after_cases"]


def test_names_of_what_can_be_chosen_are_those_that_exist():
    assert (run_option.RUN, run_option.RECONSTRUCTION) == (run_folder.CONFIG, records.FILE)
    assert tuple(presets.PRESETS) == choosable.PRESETS
    assert choosable.SPLITS == local_layout.SPLITS
    assert (registry.USUAL, *(x for x in registry.KINDS if x != registry.USUAL)) == choosable.FIELDS
    assert tuple(RULES) == choosable.RULES
    assert tuple(GEOMETRIES) == choosable.GEOMETRIES


def test_a_late_module_is_imported_when_it_is_used(monkeypatch):
    monkeypatch.delitem(sys.modules, "colorsys", raising=False)
    module = late("colorsys")
    assert "colorsys" not in sys.modules
    assert module.ONE_THIRD == 1.0 / 3.0 and "colorsys" in sys.modules
    monkeypatch.setattr(module, "ONE_THIRD", 2)
    assert sys.modules["colorsys"].ONE_THIRD == 2


def test_an_interrupt_waits_until_a_module_is_imported(tmp_path, monkeypatch):
    text = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\nwhole = True\n"
    (tmp_path / "interrupted_import.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    # What was started in the background of a script ignores Ctrl-C.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            _ = late("interrupted_import").whole
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert sys.modules.pop("interrupted_import").whole


def test_what_was_meant():
    names = ["preset", "precision", "paths"]
    assert command_line.did_you_mean("preste", names, shown="--{}") == " Did you mean --preset?"
    assert command_line.did_you_mean("zzz", names) == ""
