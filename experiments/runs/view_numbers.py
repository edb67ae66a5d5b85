"""Parses a list of views of a split, such as `0,10,20` or `all`, and the place of a pixel."""

from collections.abc import Sequence


def choose(text: str, count: int) -> Sequence[int]:
    """Returns the listed numbers of views, out of `count` views, in the order of the list.

    Raises:
      ValueError: if an entry is not a number, occurs twice, or does not exist.
    """
    if text == "all":
        return range(count)
    words = [word.strip() for word in text.split(",")]
    if not all(word.isdecimal() for word in words):
        raise ValueError(
            f"--views={text} is neither 'all' nor a list of numbers. Write as in --views=0,10,20."
        )
    views = tuple(map(int, words))
    if len(set(views)) < len(views):
        raise ValueError(f"--views={text} names a view twice. Name each once.")
    if wrong := [view for view in views if view >= count]:
        raise ValueError(f"The split has no view {wrong[0]}. Choose from 0 to {count - 1}.")
    return views


def parse_pixel(text: str | None) -> tuple[int, int] | None:
    """Returns column and row of a pixel such as `64,60`; `None` if none is given.

    Raises:
      ValueError: if the text has another form.
    """
    if text is None:
        return None
    words = [word.strip() for word in text.split(",")]
    if len(words) != 2 or not all(word.isdecimal() for word in words):
        raise ValueError(f"--pixel={text} is not a column and a row. Write as in --pixel=64,60.")
    return int(words[0]), int(words[1])
