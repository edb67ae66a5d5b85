"""A contact sheet: many small images in one, each with its name below."""

from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

_COLUMNS = 10
_GAP = 4
_TEXT_HEIGHT = 16
_PAPER, _INK = (255, 255, 255), (0, 0, 0)


def write(path: Path, images: Sequence[tuple[str, Path]], *, tile: int = 200) -> None:
    """Writes a contact sheet.

    Args:
      path: output file, a PNG.
      images: name and file of each image, row by row.
      tile: width and height of each image on the sheet, in pixels.
    """
    columns = min(_COLUMNS, len(images))
    rows = -(-len(images) // columns)
    width, height = tile + _GAP, tile + _TEXT_HEIGHT + _GAP
    sheet = Image.new("RGB", (columns * width + _GAP, rows * height + _GAP), _PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(_TEXT_HEIGHT * 3 // 4)
    for place, (name, picture) in enumerate(images):
        left = _GAP + width * (place % columns)
        top = _GAP + height * (place // columns)
        with Image.open(picture) as image:
            sheet.paste(
                image.convert("RGB").resize((tile, tile), Image.Resampling.BOX), (left, top)
            )
        draw.text((left + tile // 2, top + tile), name, _INK, font, anchor="ma")
    sheet.save(path, format="PNG")
