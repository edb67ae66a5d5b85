import dataclasses
import json
import math
import sys
from typing import Literal

import pytest

from refref_jax import configuration


@dataclasses.dataclass(frozen=True)
class _Part:
    name: str
    weights: tuple[float, ...]
    size: tuple[int, int]


@dataclasses.dataclass(frozen=True)
class _Run:
    steps: int
    rate: float
    dry: bool
    loss: Literal["mse", "charbonnier"]
    main: _Part
    others: tuple[_Part, ...]
    pairs: tuple[tuple[str, float], ...]
    limit: float | None
    spare: _Part | None


@dataclasses.dataclass(frozen=True)
class _Even:
    number: int

    def __post_init__(self):
        if self.number % 2:
            raise ValueError(f"{self.number} is odd.")


_MAIN = _Part("fläche ≥ 1", (0.5, 0.25), (3, 4))
_RUN = _Run(
    steps=7,
    rate=1e-3,
    dry=False,
    loss="mse",
    main=_MAIN,
    others=(_Part("a", (), (0, -1)), _Part("", (1.0,), (5, 6))),
    pairs=(("glass", 1.5), ("water", 1.333)),
    limit=None,
    spare=None,
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "config.json"


def _write_changed(path, change):
    """Writes the run after a change of its parsed text."""
    configuration.write(path, _RUN)
    content = json.loads(path.read_text(encoding="utf-8"))
    change(content)
    path.write_text(json.dumps(content), encoding="utf-8")


def _assert_refused(path, *words):
    with pytest.raises(ValueError) as caught:
        configuration.read(path, _Run)
    message = str(caught.value)
    for word in (path.name, *words):
        assert word in message


@pytest.mark.parametrize(
    "config",
    [
        _RUN,
        dataclasses.replace(_RUN, limit=2.5, spare=_MAIN, loss="charbonnier", dry=True),
        dataclasses.replace(_RUN, others=(), pairs=()),
        dataclasses.replace(_RUN, rate=0.1 + 0.2, limit=5e-324),
        dataclasses.replace(_RUN, rate=math.inf, limit=-math.inf),
        dataclasses.replace(_RUN, rate=sys.float_info.max, steps=-(2**70)),
    ],
)
def test_a_configuration_survives_the_round_trip(path, config):
    configuration.write(path, config)
    read = configuration.read(path, _Run)
    assert read == config
    assert isinstance(read.main, _Part)
    assert isinstance(read.pairs, tuple)


def test_the_file_is_readable_text(path):
    configuration.write(path, _MAIN)
    content = path.read_text(encoding="utf-8")
    assert content.endswith("}\n")
    assert json.loads(content) == {
        "name": "fläche ≥ 1",
        "weights": [0.5, 0.25],
        "size": [3, 4],
    }
    assert len(content.splitlines()) > 3


def test_a_float_may_be_written_as_an_integer(path):
    _write_changed(path, lambda content: content.update(rate=1, limit=2))
    read = configuration.read(path, _Run)
    assert (read.rate, read.limit) == (1.0, 2.0)
    assert isinstance(read.rate, float)
    assert isinstance(read.limit, float)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.pop("steps"), ["'steps'"]),
        (lambda c: c.pop("limit"), ["'limit'"]),
        (lambda c: c.pop("main"), ["'main'"]),
        (lambda c: c["others"][1].pop("size"), ["_Run.others[1]", "'size'"]),
        (lambda c: c.update(stpes=7), ["'stpes'"]),
        (lambda c: c["main"].update(colour="red"), ["_Run.main", "'colour'"]),
    ],
)
def test_missing_and_unknown_keys(path, change, words):
    _write_changed(path, change)
    _assert_refused(path, *words)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("steps", 7.0),
        ("steps", "7"),
        ("steps", True),
        ("steps", None),
        ("rate", "0.001"),
        ("rate", False),
        ("rate", None),
        ("rate", [0.001]),
        ("dry", 0),
        ("dry", "false"),
        ("limit", "none"),
        ("limit", True),
        ("loss", 7),
        ("loss", None),
        ("main", None),
        ("main", [1, 2]),
        ("spare", 7),
        ("others", {}),
        ("others", None),
        ("others", "ab"),
        ("pairs", 7),
    ],
)
def test_wrong_type(path, key, value):
    _write_changed(path, lambda content: content.update({key: value}))
    _assert_refused(path, f"_Run.{key}", repr(value))


@pytest.mark.parametrize("value", ["MSE", "", "mse "])
def test_wrong_choice_names_the_choices(path, value):
    _write_changed(path, lambda content: content.update(loss=value))
    _assert_refused(path, "_Run.loss", repr(value), "'mse'", "'charbonnier'")


@pytest.mark.parametrize("size", [[], [3], [3, 4, 5]])
def test_wrong_length(path, size):
    _write_changed(path, lambda content: content["main"].update(size=size))
    _assert_refused(path, "_Run.main.size", f"{len(size)} items, not 2")


def test_wrong_item_of_a_tuple_is_named_by_its_place(path):
    _write_changed(path, lambda content: content["pairs"][1].reverse())
    _assert_refused(path, "_Run.pairs[1][0]")
    _write_changed(path, lambda content: content["main"]["weights"].append("heavy"))
    _assert_refused(path, "_Run.main.weights[2]", "'heavy'")


@pytest.mark.parametrize("content", [b"", b'{"steps": 7', b"\xff\xfe", b"steps: 7"])
def test_broken_json(path, content):
    path.write_bytes(content)
    _assert_refused(path, "Correct or restore the file")


@pytest.mark.parametrize("content", ["[]", "7", "null", '"text"'])
def test_json_that_is_no_object(path, content):
    path.write_text(content, encoding="utf-8")
    _assert_refused(path, "not an object", "Correct or restore the file")


def test_missing_file(path):
    _assert_refused(path, "does not exist", "Give a folder")


def test_a_record_that_refuses_its_values_is_named(path):
    path.write_text('{"number": 3}', encoding="utf-8")
    with pytest.raises(ValueError, match=r"config\.json.*3 is odd"):
        configuration.read(path, _Even)


@dataclasses.dataclass(frozen=True)
class _Grown:
    steps: int
    since: str = "begin"


def test_a_key_that_has_a_default_may_be_missing_and_no_other(path):
    path.write_text('{"steps": 3}')
    assert configuration.read(path, _Grown) == _Grown(3, "begin")
    path.write_text('{"since": "end"}')
    with pytest.raises(ValueError, match="lacks 'steps'"):
        configuration.read(path, _Grown)
    path.write_text('{"steps": 3, "since": 4}')
    with pytest.raises(ValueError, match="since"):
        configuration.read(path, _Grown)


@dataclasses.dataclass(frozen=True)
class _Shape:
    pass


@dataclasses.dataclass(frozen=True)
class _Ball(_Shape):
    radius: float
    kind: Literal["ball"] = "ball"


@dataclasses.dataclass(frozen=True)
class _Box(_Shape):
    size: tuple[float, float]
    kind: Literal["box"] = "box"


@dataclasses.dataclass(frozen=True)
class _Scene:
    main: _Shape
    others: tuple[_Shape, ...]
    spare: _Shape | None


_SHAPES = {_Shape: {"ball": _Ball, "box": _Box}}


def test_the_key_kind_tells_variants_apart_and_the_first_is_the_default(path):
    scene = _Scene(_Ball(1.5), (_Box((1.0, 2.0)), _Ball(0.5)), _Box((3.0, 4.0)))
    configuration.write(path, scene)
    assert configuration.read(path, _Scene, variants=_SHAPES) == scene
    path.write_text('{"main": {"radius": 2}, "others": [], "spare": null}')
    assert configuration.read(path, _Scene, variants=_SHAPES) == _Scene(_Ball(2.0), (), None)


@pytest.mark.parametrize("kind", ['"cone"', "7", "null", "[]"])
def test_a_variant_that_is_not_known_is_named(path, kind):
    path.write_text(f'{{"main": {{"radius": 2, "kind": {kind}}}, "others": [], "spare": null}}')
    with pytest.raises(ValueError, match=r"_Scene\.main\.kind is .*, not one of ball, box"):
        configuration.read(path, _Scene, variants=_SHAPES)


def test_the_keys_of_a_variant_are_its_own(path):
    path.write_text('{"main": {"radius": 2, "kind": "box"}, "others": [], "spare": null}')
    with pytest.raises(ValueError, match=r"_Scene\.main lacks 'size'"):
        configuration.read(path, _Scene, variants=_SHAPES)


@pytest.mark.parametrize("before", [None, _Even(2)])
def test_who_is_stopped_while_writing_leaves_what_was_there(tmp_path, monkeypatch, before):
    path = tmp_path / "config.json"
    if before is not None:
        configuration.write(path, before)
    write_text = type(path).write_text

    def write_half(self, text, **options):
        write_text(self, text[: len(text) // 2], **options)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(type(path), "write_text", write_half)
        configuration.write(path, _Even(4))
    assert [each.name for each in tmp_path.iterdir()] == ([] if before is None else ["config.json"])
    assert before is None or configuration.read(path, _Even) == before


@dataclasses.dataclass(frozen=True)
class _Renamed:
    most_steps: int = dataclasses.field(metadata={configuration.FORMERLY: "steps"})
    rate: float = 0.5
    ending: Literal["plain", "black"] = dataclasses.field(
        default="plain", metadata={configuration.FORMER_VALUES: {"dark": "black"}}
    )


def test_a_key_of_an_earlier_version_is_read_by_its_present_name(path):
    path.write_text('{"steps": 3, "rate": 0.25}')
    assert configuration.read(path, _Renamed) == _Renamed(3, 0.25)
    configuration.write(path, _Renamed(3))
    assert json.loads(path.read_text()) == {
        "most_steps": 3,
        "rate": 0.5,
        "ending": "plain",
    }
    path.write_text('{"steps": 3, "ending": "dark"}')
    assert configuration.read(path, _Renamed) == _Renamed(3, ending="black")
    path.write_text('{"steps": 3, "most_steps": 4}')
    with pytest.raises(ValueError, match="unknown key 'steps'"):
        configuration.read(path, _Renamed)
