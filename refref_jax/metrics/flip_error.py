"""FLIP: the perceived difference of two images when flipping between them (NumPy only).

It is computed by the authors' program, an optional dependency: `pip install -e '.[flip]'`.

Source: Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild, FLIP: A Difference
Evaluator for Alternating Images, Proc. ACM Comput. Graph. Interact. Tech. 3(2), 2020.
"""

from typing import Any

import numpy as np
from jaxtyping import Float


def flip(rendered: Float[np.ndarray, "h w 3"], target: Float[np.ndarray, "h w 3"]) -> float:
    """Returns the mean of LDR-FLIP's error map, in `[0, 1]`: 0 for equal images, lower is better.

    FLIP depends on the visual angle of a pixel. The program's default is used: 67 pixels per
    degree, for a display of 3840 pixels over 0.7 m, seen from 0.7 m.

    Args:
      rendered: sRGB image in `[0, 1]`, of any size.
      target: sRGB image in `[0, 1]`, of the same size.

    Raises:
      ValueError: if flip-evaluator is not installed.
    """
    flip_evaluator = import_flip()
    pair = (np.ascontiguousarray(image, np.float32) for image in (target, rendered))
    _, mean, _ = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)
    return float(mean)


def import_flip() -> Any:
    """Returns the module `flip_evaluator`. Call this early to report that it is missing.

    Raises:
      ValueError: if the module is not installed.
    """
    try:
        import flip_evaluator
    except ImportError as error:
        raise ValueError(
            "FLIP requires the package flip-evaluator, which is not installed. Install it with "
            "pip install -e '.[flip]'."
        ) from error
    return flip_evaluator
