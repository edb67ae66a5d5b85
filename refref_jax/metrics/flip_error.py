"""FLIP: how much two images differ to an eye that flips between them (NumPy only).

Measured by the authors' own program, which is an extra: `pip install -e '.[flip]'`.

Source: Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild, FLIP: A Difference
Evaluator for Alternating Images, Proc. ACM Comput. Graph. Interact. Tech. 3(2), 2020.
"""

from typing import Any

import numpy as np
from jaxtyping import Float


def flip(rendered: Float[np.ndarray, "h w 3"], target: Float[np.ndarray, "h w 3"]) -> float:
    """Returns the mean of LDR-FLIP's error map, in `[0, 1]`: 0 for equal images, less is better.

    It depends on how large a pixel is to the eye. As the program has it by default: 67 pixels a
    degree, a display of 3840 pixels over 0.7 m, seen from 0.7 m.

    Args:
      rendered: sRGB in `[0, 1]`.
      target: likewise; of the same size, and of any.

    Raises:
      ValueError: if flip-evaluator is not installed.
    """
    flip_evaluator = import_flip()
    pair = (np.ascontiguousarray(image, np.float32) for image in (target, rendered))
    _, mean, _ = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)
    return float(mean)


def import_flip() -> Any:
    """Returns the module `flip_evaluator`, so that its lack can be told before it is needed.

    Raises:
      ValueError: if it is not installed.
    """
    try:
        import flip_evaluator
    except ImportError as error:
        raise ValueError(
            "FLIP is measured by flip-evaluator, which is not installed. Install it: "
            "pip install -e '.[flip]'."
        ) from error
    return flip_evaluator
