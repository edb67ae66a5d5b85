"""Reads a page of HTML as a browser's parser would, for tests to look into."""

from html.parser import HTMLParser
from typing import NamedTuple

_ENDLESS = ("img", "input", "meta")


class Element(NamedTuple):
    """An element: its name, its attributes, and the text in it."""

    name: str
    attributes: dict[str, str | None]
    text: list[str]


class _Reader(HTMLParser):
    def __init__(self):
        super().__init__()
        self.elements, self._open = [], []

    def handle_starttag(self, tag, attrs):
        self.elements.append(Element(tag, dict(attrs), []))
        if tag not in _ENDLESS:
            self._open.append(self.elements[-1])

    def handle_endtag(self, tag):
        assert self._open and self._open[-1].name == tag, (tag, self._open[-1:])
        self._open.pop()

    def handle_data(self, data):
        for element in self._open:
            element.text.append(data)

    def close(self):
        super().close()
        assert not self._open


def elements(text):
    """Returns all elements of a page; what is opened must be closed, in order."""
    reader = _Reader()
    reader.feed(text)
    reader.close()
    return reader.elements


def named(found, name, **attributes):
    """Returns the elements of a name and attributes; underscores stand for hyphens."""
    wanted = {key.rstrip("_").replace("_", "-"): value for key, value in attributes.items()}
    return [
        element
        for element in found
        if element.name == name and wanted.items() <= element.attributes.items()
    ]
