"""The page of a fleet: arms of several dates, arms that failed, and what a name may hold."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from made_fleets import CONFIG, dataset, moving

from tauext.data.dataset import load_dataset
from tauext.errors import ConfigError
from tauext.fleet.page import render_fleet_page, write_fleet_page
from tauext.fleet.report import FILE, make_fleet_report
from tauext.fleet.visits import visits_of
from tauext.train.stage import train_bundle

FRICTION = ((1.0, 0.9), (0.8, 1.1), (1.2, 1.0), (0.9, 1.2))
WORN = 2
"""Its elbow has half as much friction more at the second date."""


def entry(name: str, **changes: object) -> dict:
    """Of fleet.json, as `fleet run` writes it of an arm that is done."""
    stages = {"train": {"state": "done", "hash": "", "seconds": 1.0, "reason": None}}
    said = {"name": name, "type": "planar", "state": "done", "dataset": None, "bundle": None, "results": None}
    return said | {"stages": stages} | changes


def fleet_folder(folder: Path, *entries: dict) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "fleet.json").write_text(json.dumps({"format": 1, "version": "", "fleet": "", "arms": list(entries)}))
    return folder


def failed(name: str, reason: str) -> dict:
    stages = {"import": {"state": "failed", "hash": "", "seconds": 1.0, "reason": reason}}
    return entry(name, state="failed", stages=stages)


@pytest.fixture(scope="module")
def fleets(tmp_path_factory) -> list[Path]:
    """Two dates of four arms, and one that failed."""
    root, folders = tmp_path_factory.mktemp("fleets"), []
    for date, day in enumerate(("2026-05-04", "2026-06-01")):
        folder, entries = root / day, []
        for k, friction in enumerate(FRICTION):
            now = (friction[0], friction[1] * (1.5 if date and k == WORN else 1.0))
            data = dataset(folder / "data" / f"arm-{k}", moving(10 * date + k, 40.0, now))
            bundle = folder / "arms" / f"arm-{k}" / "train" / f"arm-{k}.tauext"
            bundle.parent.mkdir(parents=True)
            train_bundle(load_dataset(data), bundle, config=CONFIG, check=False)
            place = f"arms/arm-{k}/train/arm-{k}.tauext"
            entries.append(entry(f"arm-{k}", serial=f"arm-{k}", date=day, bundle=place))
        folders.append(fleet_folder(folder, *entries, failed("broken", "bag.mcap: the file <is> empty")))
    return folders


@pytest.fixture(scope="module")
def content(fleets, tmp_path_factory) -> dict:
    return make_fleet_report(fleets, tmp_path_factory.mktemp("page"))


def test_the_joint_that_wears_is_told_from_the_others(content):
    last = {arm["serial"]: arm["visits"][-1] for arm in content["arms"]}
    own = {name: visit["own"]["friction"] for name, visit in last.items() if visit["state"] == "done"}
    assert np.exp(own[f"arm-{WORN}"]["value"][1]) == pytest.approx(1.5, rel=0.05)
    likely = {name: max(one["more"]) for name, one in own.items()}
    assert max(likely, key=lambda name: likely[name]) == f"arm-{WORN}"
    for name, one in own.items():
        steady = one["value"][:1] if name == f"arm-{WORN}" else one["value"]
        assert np.exp(steady) == pytest.approx(1.0, rel=0.05)


def test_friction_at_the_speed_is_that_of_the_arm(content):
    from made_fleets import COULOMB_NM, VISCOUS

    for arm in content["arms"]:
        if arm["serial"] == "broken":
            continue
        k = int(arm["serial"][-1])
        expected = np.array(FRICTION[k]) * (COULOMB_NM + 0.5 * VISCOUS)
        assert arm["visits"][0]["friction_nm"] == pytest.approx(expected, rel=0.05)


def test_the_order_of_the_arms_does_not_matter(fleets, content, tmp_path):
    turned = []
    for fleet in fleets:
        said = json.loads((fleet / "fleet.json").read_text())
        places = [one | ({"bundle": str(fleet / one["bundle"])} if one["bundle"] else {}) for one in said["arms"][::-1]]
        turned.append(fleet_folder(tmp_path / fleet.name, *places))
    again = make_fleet_report(turned, tmp_path / "page")
    assert [arm["serial"] for arm in again["arms"]] == [arm["serial"] for arm in content["arms"]]
    for one, other in zip(content["arms"], again["arms"], strict=True):
        if one["serial"] != "broken":
            first, second = (arm["visits"][-1]["own"]["friction"]["more"] for arm in (one, other))
            assert second == pytest.approx(first, abs=2e-3)


def test_an_arm_that_failed_stands_there_with_its_reason_and_text_is_escaped(content, tmp_path):
    page = write_fleet_page(content, tmp_path).read_text()
    assert "bag.mcap: the file &lt;is&gt; empty" in page
    assert "<is>" not in page
    assert "http://" not in page and "https://" not in page and "src=" not in page


def test_arms_lead_to_their_own_pages_where_these_are(content, tmp_path):
    own = tmp_path / "arms" / "2" / "arm-1" / "report.html"
    own.parent.mkdir(parents=True)
    own.write_text("")
    page = write_fleet_page(content, tmp_path).read_text()
    links = set(re.findall(r'href="([^"]+)"', page))
    assert links == {"arms/2/arm-1/report.html"}


def test_the_file_holds_what_is_returned(content, fleets, tmp_path):
    assert make_fleet_report(fleets, tmp_path) == json.loads((tmp_path / FILE).read_text()) == content


def test_dates_decide_and_serials_say_which_arm_it_is(tmp_path):
    june = fleet_folder(tmp_path / "a", entry("new-name", serial="cell-01", date="2026-06-01"))
    may = fleet_folder(tmp_path / "b", entry("cell-01", serial="cell-01", date="2026-05-04"))
    assert [(one.serial, one.name) for one in visits_of([june, may])] == [
        ("cell-01", "cell-01"),
        ("cell-01", "new-name"),
    ]


def test_without_dates_the_folders_are_in_their_order(tmp_path):
    folders = [fleet_folder(tmp_path / name, entry("cell-01")) for name in ("z", "a")]
    assert [one.run for one in visits_of(folders)] == [0, 1]


def test_a_folder_that_is_no_fleet_is_refused_in_one_line(tmp_path):
    with pytest.raises(ConfigError, match=r"there is no such fleet; `tauext fleet run FLEET.toml --out .*` makes one"):
        visits_of([tmp_path])
    fleet = fleet_folder(tmp_path / "one", entry("cell-01"))
    with pytest.raises(ConfigError, match="the same fleet folder twice"):
        visits_of([fleet, fleet])


def test_an_arm_with_other_joints_has_a_group_of_its_own(content, tmp_path):
    """Two of the arms call their joints otherwise: as many joints, and nothing to compare them with."""
    other = json.loads(json.dumps(content))
    group = json.loads(json.dumps(content["groups"][0])) | {"joints": ["a", "b"], "tables": {}}
    other["groups"].append(group)
    for arm in [arm for arm in other["arms"] if arm["visits"][-1].get("group") == 0][:2]:
        for visit in arm["visits"]:
            visit["group"] = 1
            for table in ("own", "fleet"):
                for told in (visit.get(table) or {}).values():
                    if isinstance(told, dict):
                        told.pop("arm", None)
    page = render_fleet_page(other, {})
    assert page.count("arm-0") and page.count("arm-3")


def test_no_arm_is_done(tmp_path):
    fleet = fleet_folder(tmp_path / "one", failed("cell-01", "no bag"))
    content = make_fleet_report([fleet], tmp_path / "page")
    assert content["groups"] == content["named"] == []
    assert "no bag" in write_fleet_page(content, tmp_path / "page").read_text()
