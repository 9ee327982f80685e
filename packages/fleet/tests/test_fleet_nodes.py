"""Two Ray nodes on this machine: whatever is killed midway costs the tasks that ran, and nothing that was finished."""

import sys
from importlib.util import find_spec

import pytest
from made_fleets import QUICK, arms_of, small_dataset, write_fleet
from made_nodes import CASES, again, expect_nothing_lost, outputs

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="finds the processes of a node in /proc"),
    # Imported here, Ray would keep an environment without a token, and no later test of this process could start it.
    pytest.mark.skipif(find_spec("ray") is None, reason="needs Ray"),
]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nodes")
    small_dataset(folder / "data")
    return write_fleet(folder, QUICK + arms_of("a", "b", "c", dataset="data"))


@pytest.fixture(scope="module")
def undisturbed(fleet) -> dict[str, bytes]:
    out = fleet.parent / "undisturbed"
    assert again(fleet, out, "--workers", "1") == 0
    return outputs(out)


@pytest.mark.parametrize("case", CASES)
def test_a_kill_costs_no_finished_task_and_changes_no_byte(case, fleet, undisturbed, tmp_path):
    expect_nothing_lost(case, fleet, tmp_path / "out", undisturbed)
