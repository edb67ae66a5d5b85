"""The library snippets of README and docs run as they stand, and no local link is broken."""

import re

import pytest

from tests.experiments.command import ROOT


@pytest.mark.parametrize(
    ("page", "printed"),
    [
        ("README.md", "(128, 128, 3)"),
        # Its functions have examples of their own, which are always tested.
        pytest.param("docs/library.md", "(64, 3) (64, 3)", marks=pytest.mark.slow),
    ],
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


def test_every_local_link_of_the_readme_exists():
    links = re.findall(r"\]\(([^)#:]+)\)", (ROOT / "README.md").read_text())
    assert "docs/stability.md" in links
    assert [link for link in links if not (ROOT / link).exists()] == []
