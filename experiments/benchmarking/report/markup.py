"""Writes HTML: what is no markup is escaped where it is put in, so that no name breaks a page."""

import html
from collections.abc import Iterable

# Elements without an end tag.
_ENDLESS = ("img", "input", "meta")


class Html(str):
    """Text that is markup already; any other text is escaped where it is put in."""

    __slots__ = ()


Value = str | int | float | bool | None


def tag(name: str, /, *children: str | None, **attributes: Value) -> Html:
    """Returns an element.

    Args:
      name: of the element.
      children: what is in it, one after the other; `None` is nothing.
      attributes: underscores are written as hyphens, and one at the end is left out, as in
        `class_`. `None` and `False` leave an attribute out, `True` writes it without a value.
    """
    words = "".join(_attribute(key, value) for key, value in attributes.items())
    if name in _ENDLESS:
        return Html(f"<{name}{words}>")
    return Html(f"<{name}{words}>{join(children)}</{name}>")


def join(parts: Iterable[str | None]) -> Html:
    """Returns parts one after the other."""
    return Html("".join(_escaped(part) for part in parts if part is not None))


def _escaped(part: str) -> str:
    return part if isinstance(part, Html) else html.escape(part)


def _attribute(key: str, value: Value) -> str:
    name = key.rstrip("_").replace("_", "-")
    if value is None or value is False:
        return ""
    return f" {name}" if value is True else f' {name}="{html.escape(str(value))}"'
