"""The words of names, messages, docstrings and documents: the field's terms, in plain English.

`docs/glossary.md` has the terms. Text in backticks is code, and may name what code names.
"""

import ast
import re
from pathlib import Path

from tests.laws import syntax
from tests.laws.conventions import holds_of_all

_ROOT = Path(__file__).parents[1]
_PAGES = [
    *(_ROOT / name for name in ("README.md", "BUILD_NOTES.md", "CONTRIBUTING.md")),
    *(_ROOT / "docs").rglob("*.md"),
    *(_ROOT / "benchmarks").rglob("*.md"),
]
_MODULES = sorted(
    path
    for top in ("refref_jax", "experiments", "benchmarks")
    for path in (_ROOT / top).rglob("*.py")
)

# Words that are not the field's, each with what to write in its place.
_BANNED = {
    r"can not": "cannot",
    r"anew": "again",
    r"whoever": "users who",
    r"in the mask": "masked",
    r"elders?": "parents",
    r"manners": "conventions",
    r"strangers?": "foreign files, independent references",
    r"heed\w*": "respect",
    r"mend\w*": "fix",
    r"spoils?": "corrupts",
    r"in vain": "needlessly",
    r"seldom": "rarely",
    r"affairs?": "a plain noun",
    r"straight light": "straight rays",
    r"budgets?": "path settings",
    r"whose affair": "a plain noun",
    r"asked for": "requested, set",
    r"(?:is|are|be|was) told": "prints, reports",
    r"goes on|go on": "continues, resumes",
    r"found no room|finds no room": "dropped: buffer full",
    r"DESIGN\.md": "a page of docs",
    r"rules? \d+": "the rule itself",
    r"old ball": "the scene and its date",
    r"throw-away": "the command",
}
_PATTERN = re.compile(rf"(?<![\w./-])(?:{'|'.join(_BANNED)})(?![\w-])", re.IGNORECASE)

_ARGUMENT_LINE = re.compile(r"^  (\w[\w, ]*): (.*)$", re.MULTILINE)
_WITHOUT_NOUN = re.compile(r"(of|that|in|for|as|from|by|with|to|on|over) ")
_MOST_WITHOUT_NOUN = 0.02

_QUESTION = re.compile(r"(What|How|Who|Which|Where|Whether|When)\b")
_MOST_QUESTIONS = 10


# Parts of public names, each with what the field says. Objects and textures of the generator have
# their own terms (a vessel has a body, a bottle a wall).
_BANNED_NAMES = {
    "anew": "again",
    "bodies": "objects",
    "body": "object",
    "budget": "path settings",
    "budgets": "path settings",
    "cut": "min_throughput",
    "cuts": "thresholds",
    "doubts": "warnings",
    "dye": "attenuate",
    "dyes": "tints",
    "elders": "parents",
    "knob": "option",
    "knobs": "options",
    "leaving": "exclude_primitive",
    "lost": "dropped",
    "manners": "conventions",
    "needs": "requirements",
    "picture": "image",
    "pictures": "images",
    "room": "capacity",
    "settled": "required",
    "slot": "primitive_id",
    "told": "a plain noun",
    "walls": "background",
    "wishes": "overrides",
}
_OF_THEIR_OWN = ("experiments/dataset/objects", "experiments/dataset/textures")


def _public_names(path):
    """Yields public functions, classes, their arguments and fields."""
    for node in syntax.nodes(path):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node.name
            if isinstance(node, ast.FunctionDef):
                yield from (each.arg for each in (*node.args.args, *node.args.kwonlyargs))
            else:
                fields = (each for each in node.body if isinstance(each, ast.AnnAssign))
                yield from (each.target.id for each in fields)


def _messages(path):
    """Yields texts of several words that are not docstrings: messages, help, printed lines."""
    statements = {id(each.value) for each in syntax.nodes(path) if isinstance(each, ast.Expr)}
    for node in syntax.nodes(path):
        text = node.value if isinstance(node, ast.Constant) else None
        if isinstance(text, str) and " " in text and id(node) not in statements:
            yield text


def _docstrings(path):
    kinds = ast.Module | ast.FunctionDef | ast.ClassDef
    nodes = [node for node in syntax.nodes(path) if isinstance(node, kinds)]
    return [text for node in nodes if (text := ast.get_docstring(node))]


def _found(text):
    return _PATTERN.findall(re.sub(r"```.*?```|`[^`]*`", "", text, flags=re.DOTALL))


@holds_of_all(_MODULES)
def test_docstrings_use_the_fields_words(path):
    assert [word for text in _docstrings(path) for word in _found(text)] == []


@holds_of_all(_MODULES)
def test_messages_use_the_fields_words(path):
    assert [word for text in _messages(path) for word in _found(text)] == []


def test_public_names_are_the_fields():
    found = {
        f"{path.relative_to(_ROOT)}: {name} ({_BANNED_NAMES[word]})"
        for path in _MODULES
        if not path.relative_to(_ROOT).as_posix().startswith(_OF_THEIR_OWN)
        for name in _public_names(path)
        for word in map(str.lower, re.findall(r"[A-Za-z][a-z]*", name))
        if word in _BANNED_NAMES
    }
    assert found == set()


@holds_of_all(_PAGES)
def test_documents_use_the_fields_words(path):
    assert _found(path.read_text()) == []


def test_argument_lines_begin_with_their_noun():
    lines = [
        match
        for path in _MODULES
        for text in _docstrings(path)
        for match in _ARGUMENT_LINE.findall(text)
    ]
    without = [line for line in lines if _WITHOUT_NOUN.match(line[1])]
    assert len(lines) > 1000 and len(without) < _MOST_WITHOUT_NOUN * len(lines), without


def test_modules_say_what_they_do():
    questions = [
        path.relative_to(_ROOT).as_posix()
        for path in _MODULES
        if _QUESTION.match(ast.get_docstring(syntax.nodes(path)[0]) or "")
    ]
    assert len(questions) < _MOST_QUESTIONS, questions
