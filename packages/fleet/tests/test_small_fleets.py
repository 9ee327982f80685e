"""Fleet priors of small datasets that lack something: a healthy bundle or one line of refusal."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from small_datasets import Ending, Small, ended, train
from tauext_fleet.like import load_like
from tauext_fleet.prior import make_fleet_prior
from tauext_fleet.prior_arms import fleet_arms
from test_small_datasets import expect_sound, number

from tauext.check.finding import codes


def fleet_endings(number: int, folder: Path) -> Iterator[Ending]:
    """A fleet prior from three arms of a dataset's type, and a fourth arm that is trained with it."""
    small = Small(number)
    arms = [small.write(folder / f"arm-{k}" / "data", k) for k in range(4)]
    prior = folder / "type.prior.json"

    def made() -> str:
        make_fleet_prior(fleet_arms([str(arm) for arm in arms[:3]]), prior, small.config("prior"), tuple(codes()))
        return ""

    yield ended(*small.known_as, "fleet prior", made)
    if prior.is_file():
        out = folder / "like.tauext"
        yield ended(
            *small.known_as,
            "train --like",
            lambda: train(small, arms[3], out, "prior", tuple(codes()), load_like(prior)),
        )


ARMS = ["one joint", "one upright joint", "crossed", "wrong masses", "parallel", "weightless links"]
SIGNALS = ["minute", "last joint still", "pure noise", "zero torque", "one way", "twice the same"]
PAIRS = [(arm, signals) for i, arm in enumerate(ARMS) for k, signals in enumerate(SIGNALS) if (i + k) % 3 == 0]


@pytest.mark.slow
@pytest.mark.parametrize(("arm", "signals"), PAIRS)
def test_a_fleet_prior_of_small_datasets_ends_in_one_or_in_one_line(arm, signals, tmp_path):
    expect_sound(fleet_endings(number(arm, signals), tmp_path))
