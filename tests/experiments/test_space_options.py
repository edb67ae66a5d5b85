import pytest
from absl import flags

from experiments.r3f import flags as r3f_flags

pytestmark = pytest.mark.loose

_SPACE = r3f_flags.space()


@pytest.mark.parametrize("radius", ["inf", "nan", "0", "-3"])
def test_a_radius_is_a_finite_positive_length(radius):
    values = flags.FlagValues()
    values[_SPACE.radius.name] = flags.FLAGS[_SPACE.radius.name]
    with pytest.raises(flags.IllegalFlagValueError):
        values(["program", f"--radius={radius}"])
