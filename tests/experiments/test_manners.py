"""What all commands have in common: help, mistakes, and that nothing is replaced unasked."""

import json
import re
import subprocess
import sys
from typing import get_args

import pytest

from experiments.cli import app
from experiments.cli import flags as cli_flags
from experiments.r3f import flags as r3f_flags
from experiments.r3f import records
from experiments.r3f.geometry_stage import GEOMETRIES
from refref_jax import choices
from refref_jax.data import scene_folder
from refref_jax.fields import registry
from refref_jax.optics.interface_rules import RULES
from refref_jax.optics.path_settings import PATH_PRESETS
from refref_jax.training import presets, run_folder
from tests.processes.command import ROOT

pytestmark = pytest.mark.loose

_SCRIPTS = [
    path.relative_to(ROOT / "experiments").with_suffix("")
    for path in (ROOT / "experiments").rglob("*.py")
    if "\n    app.run(" in path.read_text("utf-8")
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
    "align": (["--scene=x", "--out=FOLDER"], "placement.json"),
    "accelerator_check": (["--out=FOLDER"], "report.md"),
    "convert_lpips": (["--alexnet=x", "--lpips=x", "--out=FOLDER/a.npz"], "a.npz"),
    "dataset.check": (["FOLDER"], "check.html"),
}

_OF_THE_SCENE = {
    "--cut=1": "min_throughput=1.0: min_throughput is 1.0",
    "--bends=-1": "max_bends is -1, which is negative. Give 0 or more.",
    "--samples=4,0": "samples_per_ray is 4,0, not a list of positive numbers. Use a list",
    "--samples=a": "is not a list of numbers. Write as in --samples_per_ray=32,20.",
    "--blurs=x": "--blurs=x is not a list of numbers. Write as in --blurs=0.03,0.003.",
    "--multisamples=3": "Give 1 (the centre line) or 6",
    "--field_ball=0,a,0,2": "is not a list of 4 numbers. Write as in --field_ball=0,0,0,2.",
    "--field_ball=0,0,2": "is not a list of 4 numbers. Write as in --field_ball=0,0,0,2.",
    "--field_ball=0,0,0,-2": "Give its centre and a positive radius, x,y,z,radius.",
    "--entries=40": "Give 1 to 31",
    "--paths=straight --cut=0.1": "Leave them out, or use paths=tree.",
    "--ior=1.5": "Write as in --ior=glass=1.52.",
    "--ior=glass=-1": "with a positive number",
    "--method=r3f --ior=glass=1.5": "Pass its index once",
    "--resolution=32": "or add --method=r3f.",
    "--resume=maybe": "Non-boolean argument",
    "--steps": "Missing value for flag --steps",
    "--steps=many": "flag --steps=many",
    "--cut=auto --paths=straight --bends=3": "use paths=tree",
    "--devices=two": "Give a number, or all.",
    "--properties=nowhere.json": "nowhere.json does not exist. Give a JSON file of properties",
    "--properties=OVERLAY": "overlay.json: rul is not a known key. Write 'rule', or remove it.",
    "--rule=nestd": "flag --rule=nestd",
}

# On top of a file that names a reconstruction, and asks for cut=0.01.
_ON_TOP_OF_R3F = {
    "--ior=glass=1.5": "--ior=glass=1.5 is invalid for the single reconstructed object",
    "--resolution=32": "r3f is already reconstructed. Remove it, or add --method=r3f.",
    "--reconstruction=x --method=oracle": "Remove either --method or --reconstruction.",
    "--paths=straight": "config.json names the reconstruction",
    "--paths=straight --method=oracle": "Leave them out, or use paths=tree.",
    "--method=oracle --ior=1.5": "Write as in --ior=glass=1.52.",
    "--method=oracle --resolution=32": "nothing is reconstructed. Remove it",
    "--scene=": "--scene is empty. Give a folder, or hf:CONFIG/SCENE",
    "--scene=nowhere": "nowhere/transforms_train.json does not exist",
}

# What absl does not know the values of, and what is not there; of each command, with its refusal.
_MISTAKES = {
    "train": {
        "--out=OUT --scene=nowhere": "nowhere/transforms_train.json does not exist",
        "--out=OUT --scene=hf:cubebg/cube_smcvx_ball": "not a configuration of the data set",
        "--out=OUT": "Add --scene=FOLDER, or --resume",
        "--out=OUT --scene=": "--scene is empty. Give a folder, or hf:CONFIG/SCENE",
        "--out=OUT --config=nowhere.json": "nowhere.json is not a file.",
        "--out=/dev/null/x --scene=SCENE": "--out=/dev/null/x cannot be written to (Not a dir",
        "--out=OUT --config=": "--config is empty. Give a file",
        "--out=OUT --config=BARE": "which does not exist. Set --reconstruction to",
        **{f"--out=OUT --config=CONFIG {x}": told for x, told in _ON_TOP_OF_R3F.items()},
        **{f"--out=OUT --scene=SCENE {words}": told for words, told in _OF_THE_SCENE.items()},
    },
    "evaluate": {
        "--run=x --rays_per_pixel=8": "Give 4 or 9.",
        "--run=nowhere": "nowhere/config.json does not exist",
    },
    "render": {"--run=nowhere": "nowhere/config.json does not exist"},
    "render_known": {
        "--out=OUT --scene=nowhere": "nowhere/transforms_train.json does not exist",
        "--out=OUT --scene=": "--scene is empty. Give a folder",
        "--out=OUT --scene=SCENE --cut=-0.5": "Give 0.02 for 2 %",
        "--out=OUT --scene=SCENE --ior=glass": "Write as in --ior=glass=1.52.",
        "--out=OUT --scene=SCENE --paths=straight --unfinished=dark": "no path is truncated",
        "--out=OUT --scene=SCENE --views=1,1": "names a view twice",
        "--out=OUT --scene=SCENE --properties=OVERLAY": "overlay.json: rul is not a known key.",
    },
    "path_trade_off": {
        "--out=OUT --scenes=SCENE,nowhere": "nowhere/transforms_train.json does not exist",
        "--out=OUT --scenes=SCENE --cuts=2": "Give 0.02 for 2 %",
        "--out=OUT --scenes=SCENE --cuts=a": "list of numbers",
        "--out=OUT --scenes=SCENE --ior=glass=x": "Write as in --ior=glass=1.52.",
        "--out=OUT --scenes=SCENE --views=a": "as in --views=0,10,20",
        "--out=OUT --scenes=SCENE --properties=OVERLAY": "overlay.json: rul is not a known key.",
    },
    "glass_figures": {
        "--out=OUT --scene=nowhere": "nowhere/transforms_train.json does not exist",
        "--out=OUT --scene=SCENE --ior==1.5": "Write as in --ior=glass=1.52.",
        "--out=OUT --scene=SCENE --properties=OVERLAY": "overlay.json: rul is not a known key.",
        "--out=OUT --scene=SCENE --pixel=4": "--pixel=4 is not a column and a row",
        "--out=OUT --scene=SCENE --pixel=4,5": "--pixel would have no effect. Add --figure=samples",
        "--out=OUT --scene=SCENE --figure=samples": "shows trained runs. Give them, as in --runs",
        "--out=OUT --scene=SCENE --figure=samples --runs=x": "x/config.json does not exist",
    },
    "view": {
        "--run=x --heights=2,1": "increasing integers",
        "--run=x --heights=36": "--heights=36 are not",
        "--run=x --heights=small,large": "--heights=36,90,180",
        "--run=nowhere": "nowhere/config.json does not exist",
    },
    "export": {
        "--run=x --what=object --out=a.obj": "ends in .ply",
        "--run=x --what=faces --out=a.ply": "ends in .png or .exr",
        "--run=nowhere --what=mesh --out=OUT.ply": "nowhere/config.json does not exist",
        "--run=nowhere --what=object --out=OUT.ply": "nowhere/config.json does not exist",
    },
    "reconstruct": {
        "--out=/dev/null/x --scene=SCENE": "--out=/dev/null/x cannot be written to (Not a dir",
        "--out=OUT --scene=x --ior=0.5": "--ior=0.5 is not an index",
        "--out=OUT --scene=nowhere": "nowhere/transforms_train.json does not exist",
        "--out=OUT --scene=SCENE --properties=OVERLAY": "overlay.json: rul is not a known key.",
    },
    "trade_off": {
        "--out=OUT --scene=x --steps=0,1": "Give 1 or more.",
        "--out=OUT --scene=x --steps=many": "list of numbers",
        "--out=OUT --scene=nowhere": "nowhere/transforms_train.json does not exist",
    },
    "accelerator_check": {"--out=OUT --presets=tiny,papper": "Did you mean paper?"},
    "recommend": {"--scene=nowhere --minutes=1": "nowhere/transforms_train.json does not exist"},
    "import_masks": {
        "--out=OUT --scene=nowhere --masks=x": "nowhere/transforms_train.json does not exist"
    },
    "benchmark": {
        "--out=OUT --methods=tree,strait": "Did you mean straight?",
        "--out=OUT --scenes=SCENE,nowhere": "nowhere/transforms_train.json does not exist",
        "--out=OUT --scenes=SCENE --external=tree=x": "The name tree of --external=tree=x is taken",
        "--out=OUT --scenes=nowhere.csv": "nowhere.csv does not exist. Give scenes, or a JSON",
        "--out=OUT --scenes=LIST": "list.json: scene 1: 'rul' is not a known key. Write 'rule'",
    },
    "dataset.convert": {"--scene=nowhere --to=raw --out=OUT": "nowhere is not a folder."},
    "dataset.make": {
        "--out=OUT --scenes=cube_smcvx_bal": "Did you mean cube_smcvx_ball",
        "--out=OUT --blender=nowhere": "make dataset-env",
        "--out=": "flag --out=: Give a path to write to.",
    },
    "dataset.check": {
        "x --cut=2": "Give 0.02 for 2 %",
        "nowhere": "nowhere is not a folder.",
    },
    "capture_to_model": {
        "--source=nowhere --out=OUT": "nowhere is not a folder.",
        "--source=x --out=OUT --steps=0": "--steps",
    },
    "import_capture": {
        "--source=x --out=OUT --scale=-1": "Give a positive number",
        "--source=x --out=OUT --centre=1,2": "Give x,y,z",
        "--source=x --out=OUT --centre=1,2,x": "has 'x', which is not a finite number",
        "--source=nowhere --out=OUT": "nowhere is not a folder.",
    },
}


@pytest.fixture(scope="module")
def tried(tmp_path_factory):
    """What each command answered, and the folder that held what was in its way."""
    cases, folders = {}, {}
    given = tmp_path_factory.mktemp("given")
    content = {"scene": {"path": str(_SCENE), "reconstruction": "r3f"}, "paths": {"cut": 0.01}}
    (given / "overlay.json").write_text('{"rul": "facing"}')
    (given / "list.json").write_text('[{"scene": "x", "rul": "facing"}]')
    (given / "r3f").mkdir()
    (given / "r3f" / cli_flags.RECONSTRUCTION).write_text("{}")
    for folder in (given, given / "r3f"):
        (folder / "config.json").write_text(json.dumps(content))
    out = tmp_path_factory.mktemp("mistakes") / "out"
    for command in _COMMANDS:
        cases[command] = [_words(line, out, given) for line in _MISTAKES.get(command, ())]
        if command in _IN_THE_WAY:
            words, name = _IN_THE_WAY[command]
            folder = folders[command] = tmp_path_factory.mktemp(command)
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text("mine")
            cases[command].append([word.replace("FOLDER", str(folder)) for word in words])
    done = subprocess.run(
        [sys.executable, "-m", "tests.processes.print_manners"],
        input=json.dumps(cases),
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert not list(out.parent.iterdir())
    return json.loads(done.stdout), folders


def _words(line, out, given):
    config, bare = given / "config.json", given / "r3f" / "config.json"
    for word, name in (("OVERLAY", "overlay.json"), ("LIST", "list.json")):
        line = line.replace(word, str(given / name))
    line = line.replace("OUT", str(out)).replace("SCENE", str(_SCENE))
    return line.replace("CONFIG", str(config)).replace("BARE", str(bare)).split()


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
def test_help_is_what_the_command_does_and_its_own_flags(tried, command):
    answer = tried[0][command]
    printed = answer["help"]["out"]
    assert answer["help"]["status"] == 0 and not answer["help"]["err"]
    assert answer["options"]
    shown = re.findall(r"^  (?:-\w,)?--(?:\[no\])?(\w+):", printed, re.MULTILINE)
    assert set(shown) == set(answer["options"])
    first = answer["documented"].splitlines()[0]
    assert len(first) > 20 and f"python -m experiments.{command} " in answer["documented"]


@pytest.mark.parametrize("command", _COMMANDS)
def test_mistakes_are_told_with_what_was_meant_before_jax_is_imported(tried, command):
    answer = tried[0][command]
    assert len(answer["wrong"]) >= 2
    for meant, refused in answer["wrong"]:
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
    assert answer["interrupted"]["status"] == app.INTERRUPTED == 130
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
    left = [path for path in folders[command].rglob("*") if path.is_file()]
    assert left == [folders[command] / name] and left[0].read_text() == "mine"
    assert not answers[command]["jax_after_cases"]


def test_names_of_what_can_be_chosen_are_those_that_exist():
    assert (cli_flags.RUN, cli_flags.RECONSTRUCTION) == (run_folder.CONFIG, records.FILE)
    assert tuple(presets.PRESETS) == get_args(choices.PresetName)
    assert get_args(choices.Split) == scene_folder.SPLITS
    names = (registry.USUAL, *(x for x in registry.KINDS if x != registry.USUAL))
    assert (*names, presets.SPLATS) == get_args(choices.FieldName)
    assert tuple(RULES) == get_args(choices.RuleName)
    assert tuple(PATH_PRESETS) == get_args(choices.Paths)
    assert tuple(GEOMETRIES) == r3f_flags.GEOMETRIES


def test_what_was_meant():
    names = ["preset", "precision", "paths"]
    assert app.did_you_mean("preste", names) == " Did you mean preset?"
    assert app.did_you_mean("zzz", names) == ""
