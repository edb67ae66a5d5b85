"""The views of a split that an option names, as `0,10,20` or `all`."""


def parse(text: str) -> tuple[int, ...] | None:
    """Returns the numbers in their order; `None` for all.

    Raises:
      ValueError: if one is not a number, or comes twice.
    """
    if text == "all":
        return None
    words = [word.strip() for word in text.split(",")]
    if not all(word.isdecimal() for word in words):
        raise ValueError(
            f"--views={text} is neither 'all' nor a list of numbers. Write as in --views=0,10,20."
        )
    views = tuple(map(int, words))
    if len(set(views)) < len(views):
        raise ValueError(f"--views={text} names a view twice. Name each once.")
    return views


def choose(text: str, count: int) -> tuple[int, ...]:
    """Returns the numbers of views of a split that has so many.

    Raises:
      ValueError: as `parse`, or if there is no such view.
    """
    views = parse(text)
    if views is None:
        return tuple(range(count))
    if wrong := [view for view in views if view >= count]:
        raise ValueError(f"The split has no view {wrong[0]}. Choose from 0 to {count - 1}.")
    return views
