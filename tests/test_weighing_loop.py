"""Loads weighed inside the loop: what a person asks for, and what the loop reports."""

from __future__ import annotations

import json

import pytest
from made_arms import six_axis_tree
from made_live import Keeper, ScriptedSource, samples_of
from made_recordings import made_motion
from test_weighing import COM, MASS, QUIET, bundle_of, carrying, phi_of

from tauext import _core
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.monitor.changes import WeighChange
from tauext.monitor.control_lines import obey
from tauext.monitor.loop import Loop


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> _core.Tree:
    return six_axis_tree(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def recordings(arm) -> dict[str, Recording]:
    def moved(tree: _core.Tree, seed: int) -> Recording:
        return made_motion(tree, 0.2, pieces=1, seed=seed, drive=QUIET).recordings[0]

    return {"free": moved(arm, 4), "loaded": moved(carrying(arm, phi_of(MASS, COM)), 3)}


def settable(bundle: _core.Bundle) -> _core.Bundle:
    bundle.assume_load()
    return bundle


def test_where_nothing_can_be_weighed_says_why(arm, recordings):
    bundle = bundle_of(arm, recordings["free"])
    with pytest.raises(_core.CoreError, match="reach of a payload = 0 m must be above 0"):
        _core.Monitor(settable(bundle)).start_weighing(0.0)
    bundle.load_settings = _core.LoadSettings()
    with pytest.raises(_core.CoreError, match="no payload can be identified: the bundle names no frame for a payload"):
        _core.Monitor(bundle).start_weighing()


def test_a_live_monitor_weighs_when_a_line_asks(arm, recordings, capsys):
    bundle, loaded = settable(bundle_of(arm, recordings["free"])), recordings["loaded"]
    unreachable = ["0", "1e9", "-1"]
    lines = {
        19: [f"weigh reach={reach}" for reach in unreachable],
        20: ["weigh reach=nan", "weigh reach=far", "weigh now", "weigh reach=0.25"],
        40: ["weigh report"],
        700: ["weigh report", "weigh stop"],
    }
    said: list[str] = []

    def ask(verdict):
        for line in lines.get(verdict.row, ()):
            said.append(obey(line, keeper.control, "a line"))

    keeper = Keeper(ask)
    loop = Loop(bundle, ScriptedSource(samples_of(loaded, slice(0, 800))), [keeper])
    loop.run()
    rule = "must be 0.001 to 100 m, how far away a payload's centre of mass may be"
    assert said[:3] == [f"error: reach = {float(reach)} {rule}" for reach in unreachable]
    choices = "must be `reach=METRES`, `report`, `stop` or nothing"
    assert said[3:6] == [f"error: weigh: {text!r} {choices}" for text in ("reach=nan", "reach=far", "now")]
    assert said[6:] == ["ok"] * 4
    told = [change for change in keeper.changes if isinstance(change, WeighChange)]
    assert [(one.row, one.what, one.by) for one in told] == [
        (21, "start", "a line"), (41, "report", "a line"), (701, "report", "a line"), (701, "stop", "a line"),
    ]  # fmt: skip
    assert told[0].found is None and told[1].found.verdict == "too little"
    assert abs(told[2].found.mass_kg - MASS) < 0.05 and told[2].found.reach_m == 0.25
    assert not loop.monitor.weighing
    sentences = [change.words(()) for change in told]
    assert sentences[0] == ["identifying the payload, by a line"]
    assert sentences[1] == ["0.00 s of healthy motion are too little to identify a payload"]
    assert sentences[2][0].startswith("load 1.6")
    facts = told[2].facts(())
    assert facts["found"]["verdict"] == "load" and json.loads(json.dumps(facts)) == facts
    assert facts["load"]["mass_kg"] == told[2].found.load.mass and 0 < facts["load"]["error_share"] <= 1
    bundle.load_settings = _core.LoadSettings()
    with pytest.raises(ConfigError, match="the bundle names no frame for a payload"):
        Loop(bundle, ScriptedSource([])).weigh("start", "test")
