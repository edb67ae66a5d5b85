"""The library snippets of README and docs run as they stand, and no local link is broken."""

import ast
import functools
import re

import pytest

from tests.processes.command import ROOT

pytestmark = pytest.mark.loose

_PAGES = ["README.md", *sorted(f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md"))]
_DECISIONS = sorted(page.name for page in (ROOT / "docs/decisions").glob("[0-9]*.md"))
_LINKING = [
    *_PAGES,
    *(f"docs/decisions/{name}" for name in ["README.md", *_DECISIONS]),
    "BUILD_NOTES.md",
    "benchmarks/results/README.md",
]

# A link, or a picture: its text, the file if it is another one, and the heading if one is named.
_LINK = re.compile(r"\[(?P<text>[^\]]*)\]\((?P<file>[^)#:\s]*)(?:#(?P<heading>[^)\s]*))?\)")


# Slow, since their functions have examples of their own, which are always tested.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "printed"),
    [("README.md", "(128, 128, 3)"), ("docs/library.md", "(64, 3) (64, 3)")],
)
def test_the_snippets_of_a_page_run(page, printed, trained, tmp_path, monkeypatch, capsys):
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    assert len(snippets) >= 2
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "demo").symlink_to(trained)
    (tmp_path / "experiments").symlink_to(ROOT / "experiments")
    monkeypatch.chdir(tmp_path)
    namespace = {}
    for snippet in snippets:
        exec(compile(snippet, page, "exec"), namespace)
    assert printed in capsys.readouterr().out


@pytest.mark.parametrize("page", _LINKING)
def test_every_local_link_leads_somewhere(page):
    assert [link.group() for link in _links(page) if not _leads_somewhere(page, link)] == []


def test_the_index_and_the_readme_lead_to_every_page():
    pages = {page.removeprefix("docs/") for page in _PAGES} - {"README.md"}
    assert {link["file"] for link in _links("docs/README.md")} == {*pages, "decisions/README.md"}
    linked = {link["file"].removeprefix("docs/") for link in _links("README.md")}
    assert linked >= pages


def test_the_index_of_decisions_leads_to_every_one_in_their_order():
    linked = [link["file"] for link in _links("docs/decisions/README.md")]
    assert [file for file in linked if file[0].isdigit()] == _DECISIONS


@pytest.mark.parametrize("page", _PAGES)
def test_a_name_that_links_to_code_is_defined_there(page):
    lost = []
    for link in _links(page):
        if link["file"].endswith(".py") and link["text"].startswith("`"):
            file = ((ROOT / page).parent / link["file"]).resolve()
            if link["text"].strip("`") not in _defined(file):
                lost.append(link.group())
    assert lost == []


def test_every_section_of_the_method_names_a_function_and_a_test():
    text = (ROOT / "docs/method.md").read_text()
    sections = re.split(r"^## (?=\d)", text, flags=re.MULTILINE)[1:]
    assert len(sections) == 9
    for section in sections:
        section = section.split("\n## ")[0]
        assert "$$" in section
        assert "](../refref_jax/" in section and "[`test_" in section, section.splitlines()[0]


@pytest.mark.parametrize("page", _PAGES)
def test_formulas_are_such_that_github_draws_them(page):
    text = (ROOT / page).read_text()
    assert len(re.findall(r"^\$\$$", text, re.MULTILINE)) == text.count("$$")
    for formula in re.findall(r"\$\$(.*?)\$\$", text, re.DOTALL):
        # Markdown takes these for its own, and GitHub refuses the last.
        for wrong in (r"^\s*$\n.", r"^[-+*] ", r"\\[,;!{}]", "<", r"\\operatorname"):
            assert not re.search(wrong, formula.strip(), re.MULTILINE), formula


@pytest.mark.parametrize("page", _LINKING)
def test_every_command_on_a_page_exists(page):
    text = (ROOT / page).read_text()
    modules = set(re.findall(r"python -m ((?:experiments|benchmarks)\.[a-z0-9_.]*[a-z0-9])", text))
    assert [name for name in modules if not _exists(name)] == []
    assert set(re.findall(r"^make ([a-z-]+)", text, re.MULTILINE)) <= _targets()


def _exists(name):
    module = ROOT / name.replace(".", "/")
    return module.with_suffix(".py").exists() or (module / "__main__.py").exists()


def _links(page):
    # What stands in code is no link; a link's text may be code.
    text = re.sub(r"```.*?```", "", (ROOT / page).read_text(), flags=re.DOTALL)
    return list(_LINK.finditer(text))


def _leads_somewhere(page, link):
    target = (ROOT / page).parent / link["file"] if link["file"] else ROOT / page
    if link["heading"] is None:
        return target.exists()
    return target.exists() and link["heading"] in _headings(target)


@functools.cache
def _headings(page):
    """Returns what GitHub calls the headings of a page in links."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    titles = re.findall(r"^#+ (.*?)\s*$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@functools.cache
def _defined(file):
    """Returns the names that a module defines."""
    names = set()
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return names


def _targets():
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
