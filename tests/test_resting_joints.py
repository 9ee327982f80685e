"""Joints that rest: a bundle that does not monitor them, or one sentence, whatever recipe, case, unit and rate."""

import itertools

import pytest
from resting_joints import COUNT, Cell, cells

STEP = 46993
"""No factor of it is one of the lists' lengths: neighbours differ in every choice."""
CHUNK = 10
CHUNKS = 4
FEW = (59173, 5311)
"""Always used: without noise, NaN came of the choice of the gain; no model."""


def expect_sound(numbers):
    endings = [Cell(number).ending() for number in numbers]
    bad = [f"{one.number} {one.words}: {one.fault}" for one in endings if one.fault]
    assert not bad, "\n".join(bad)


@pytest.mark.parametrize("number", FEW)
def test_a_resting_joint_ends_no_training_badly(number):
    expect_sound([number])


@pytest.mark.slow
@pytest.mark.parametrize("first", range(CHUNKS))
def test_every_pair_of_choices_ends_in_a_sound_bundle_or_one_sentence(first):
    expect_sound(itertools.islice(cells(5 + first * CHUNK * STEP, STEP), CHUNK))


def test_the_cells_that_are_drawn_meet_every_choice():
    drawn = [Cell(number).choices for number in itertools.islice(cells(5, STEP), CHUNK * CHUNKS)]
    every = [Cell(number).choices for number in range(0, COUNT, 101)]
    assert [set(one) for one in zip(*drawn, strict=True)] == [set(one) for one in zip(*every, strict=True)]
