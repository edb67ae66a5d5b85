import pytest
from absl import flags

from experiments.cli import space_options


@pytest.mark.parametrize("radius", ["inf", "nan", "0", "-3"])
def test_a_radius_is_a_finite_positive_length(radius):
    values = flags.FlagValues()
    values[space_options.RADIUS.name] = flags.FLAGS[space_options.RADIUS.name]
    with pytest.raises(flags.IllegalFlagValueError):
        values(["program", f"--radius={radius}"])
