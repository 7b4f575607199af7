"""A program that is not there is noticed before a run, not after training."""

import sys

import pytest

from pipeline.plan.hole_painter import check_hole_painter
from pipeline.runtime.errors import UserError


@pytest.mark.parametrize("fill", ["inpant", "no-such-program --radius 9", "./missing.sh"])
def test_a_program_that_is_not_there_is_an_error(fill: str) -> None:
    with pytest.raises(UserError, match="expected none, inpaint or a command, found"):
        check_hole_painter(fill)


@pytest.mark.parametrize("fill", ["inpaint", f"'{sys.executable}' -c pass"])
def test_inpainting_and_programs_that_are_there_are_accepted(fill: str) -> None:
    check_hole_painter(fill)
