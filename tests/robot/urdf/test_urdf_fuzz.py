"""Two hundred of the hostile files of `fuzz_urdf`; `python tests/tools/fuzz_urdf.py` takes twenty thousand."""

from collections import Counter

import fuzz_urdf
import pytest
from fuzz_urdf import MEGABYTES, case, outcome
from helpers import thinned

BATCH = 50
ENDLESS = 30.0  # seconds; `fuzz_urdf.py` measures time, on a machine that does nothing else


@pytest.mark.case("U2", "U3", "U5", "U6", "U7", "U8")
@pytest.mark.parametrize("batch", thinned(range(10), range(2)))
def test_a_hostile_file_is_a_robot_or_one_of_the_packages_errors(batch):
    outcome(fuzz_urdf.Case(fuzz_urdf.FILES[0], {}))  # the first has to import things
    fates = Counter()
    for number in range(BATCH * batch, BATCH * (batch + 1)):
        found = outcome(case(number))
        assert found.seconds < ENDLESS and found.megabytes < MEGABYTES, (number, found)
        fates[found.kind] += 1
    assert fates["Robot"] >= 5 and fates["DescriptionError"] >= 5  # wounds are neither all deadly nor all harmless


@pytest.mark.parametrize("text", fuzz_urdf.FILES)
@pytest.mark.parametrize("base", ["fixed", "floating"])
def test_the_files_are_sound_before_they_are_wounded(text, base):
    assert outcome(fuzz_urdf.Case(text, {"base": base})).kind == "Robot"


def test_a_number_makes_the_same_file_again():
    assert case(1234) == case(1234) and case(1234) != case(1235)
